"""The template of the report: plain HTML, no scripts, nothing loaded, good in print.

Rendered by Jinja, which escapes everything but the drawings: SVG of
`redetect.groundtruth.report.svg`.
"""

from __future__ import annotations

STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.45 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; color: #1b1a18;
  background: #fff; max-width: 50rem; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.6rem; margin: .4rem 0; } h2 { font-size: 1.2rem; margin: 2rem 0 .4rem;
  border-bottom: 1px solid #bbb; }
a { color: #14508a; } a:focus, [tabindex]:focus { outline: 3px solid #14508a; outline-offset: 2px; }
.skip { position: absolute; left: -99rem; } .skip:focus { position: static; }
nav ul { padding: 0; margin: .5rem 0; } nav li { display: inline-block; margin-right: 1rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .86rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; padding: .3rem 0; color: #444; }
th, td { padding: .15rem .6rem .15rem 0; text-align: right; border-bottom: 1px solid #e3e1dd;
  vertical-align: top; }
th[scope=row], td.text, th.text { text-align: left; overflow-wrap: break-word; }
svg, img { max-width: 100%; height: auto; display: block; } figure { margin: .6rem 0; }
figcaption { font-size: .86rem; color: #444; }
.problem { border-left: 4px solid #a8321e; padding-left: .7rem; }
.note { color: #444; font-size: .9rem; }
@media print { @page { margin: 14mm; } body { font-size: 10pt; max-width: none; padding: 0; }
  nav, .skip { display: none; } figure, tr { break-inside: avoid; }
  h2, caption, thead { break-after: avoid; }
  .wide { overflow: visible; } a { color: inherit; text-decoration: none; } }
"""

PAGE = """\
{%- macro table(data) %}
<div class="wide" tabindex="0" role="region" aria-label="{{ data.words }}"><table>
<caption>{{ data.words }}</caption>
<thead><tr>{% for name in data.head %}
<th scope="col"{% if loop.first or loop.index0 in data.text %} class="text"{% endif %}>{{ name }}</th>
{%- endfor %}</tr></thead>
<tbody>{% for row in data.rows %}
<tr>{% for word in row %}{% if loop.first %}<th scope="row">{{ word }}</th>
{%- elif loop.index0 in data.text %}<td class="text">{{ word }}</td>
{%- else %}<td>{{ word }}</td>{% endif %}{% endfor %}</tr>
{%- endfor %}</tbody></table></div>
{%- endmacro -%}
<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
{# Were anything to slip through, it could load and run nothing. -#}
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; style-src 'unsafe-inline'; img-src data:">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>{{ style }}</style></head>
<body><a class="skip" href="#main">To the contents</a>
<header><h1>{{ title }}</h1>
<nav aria-label="Sections"><ul>
{%- for section in sections %}<li><a href="#{{ section.key }}">{{ section.name }}</a></li>
{%- endfor %}</ul></nav></header>
<main id="main">
{%- for section in sections %}
<section id="{{ section.key }}" aria-labelledby="{{ section.key }}-head">
<h2 id="{{ section.key }}-head">{{ section.name }}</h2>
{%- for part in section.parts %}
{%- if part.kind == "table" %}{{ table(part) }}
{%- elif part.kind == "figure" %}
<figure>{% for drawing in part.drawings %}{{ drawing }}
{% endfor %}<figcaption>{{ part.words }}</figcaption></figure>
{%- elif part.kind == "picture" %}
<figure><img src="{{ part.address }}" alt="{{ part.instead }}">
<figcaption>{{ part.words }}</figcaption></figure>
{%- else %}
<p{% if part.kind != "paragraph" %} class="{{ part.kind }}"{% endif %}>{{ part.words }}</p>
{%- endif %}{% endfor %}
</section>
{%- endfor %}
</main></body></html>
"""  # noqa: E501
