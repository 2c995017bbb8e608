"""The parts of a report, and the template that makes a page of them.

Plain HTML, no scripts, nothing loaded, good in print. Rendered by Jinja with everything escaped;
figures are data: addresses.
"""

from __future__ import annotations

import base64
from typing import NamedTuple


class Part(NamedTuple):
    """A piece of a section; its kind says what the template makes of it.

    `words` are the text or the caption. Rows of figures are names and values, those of a key
    colours and words. `left` are the columns of a table that have text, `bold` the rows to point
    out.
    """

    kind: str
    words: str = ""
    head: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    left: tuple[int, ...] = (0,)
    bold: tuple[int, ...] = ()
    address: str = ""
    width: int = 0
    height: int = 0


class Section(NamedTuple):
    """A section with its heading."""

    key: str
    name: str
    parts: list[Part]


def image_part(words: str, content: bytes, kind: str, width: float, height: float) -> Part:
    """An image with its caption; `kind` is its type behind ``image/``."""
    address = f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
    return Part("image", words, address=address, width=round(width), height=round(height))


STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.45 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; color: #1b1a18;
  background: #fff; max-width: 54rem; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.6rem; margin: .4rem 0; }
h2 { font-size: 1.25rem; margin: 2rem 0 .4rem; border-bottom: 1px solid #bbb; }
h3 { font-size: 1.05rem; margin: 1.2rem 0 .2rem; }
a { color: #14508a; }
a:focus, [tabindex]:focus { outline: 3px solid #14508a; outline-offset: 2px; }
.skip { position: absolute; left: -99rem; } .skip:focus { position: static; }
nav ul { padding: 0; margin: .5rem 0; } nav li { display: inline-block; margin-right: 1rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .86rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; padding: .3rem 0; color: #444; }
th, td { padding: .15rem .6rem .15rem 0; text-align: right; border-bottom: 1px solid #e3e1dd;
  vertical-align: top; }
th[scope=row], td.text, th.text { text-align: left; overflow-wrap: anywhere; }
img { max-width: 100%; height: auto; display: block; } figure { margin: .6rem 0; }
figcaption, .note { font-size: .88rem; color: #444; }
dl.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(9.5rem, 1fr));
  gap: .5rem; margin: .8rem 0; }
dl.figures div { border: 1px solid #d8d5cf; border-radius: .3rem; padding: .4rem .6rem; }
dl.figures dt { font-size: .8rem; color: #444; } dl.figures dd { margin: 0; font-size: 1.25rem; }
.changed { font-weight: 700; }
.key span { white-space: nowrap; margin-right: 1rem; }
.swatch { display: inline-block; width: 1.6rem; border-top: 4px solid; vertical-align: middle; }
@media print { @page { margin: 14mm; } body { font-size: 10pt; max-width: none; padding: 0; }
  nav, .skip { display: none; } figure, tr, dl.figures { break-inside: avoid; }
  h2, h3, caption, thead { break-after: avoid; } .wide { overflow: visible; }
  a { color: inherit; text-decoration: none; } }
"""

PAGE = """\
<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
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
{%- if part.kind == "figures" %}
<dl class="figures">{% for name, value in part.rows %}
<div><dt>{{ name }}</dt><dd>{{ value }}</dd></div>{% endfor %}</dl>
{%- elif part.kind == "image" %}
<figure><img src="{{ part.address }}" alt="{{ part.words }}"
 width="{{ part.width }}" height="{{ part.height }}">
<figcaption>{{ part.words }}</figcaption></figure>
{%- elif part.kind == "table" %}
<div class="wide" tabindex="0" role="region" aria-label="{{ part.words }}"><table>
<caption>{{ part.words }}</caption>
<thead><tr>{% for name in part.head %}
<th scope="col"{% if loop.index0 in part.left %} class="text"{% endif %}>{{ name }}</th>
{%- endfor %}</tr></thead>
<tbody>{% for row in part.rows %}
<tr{% if loop.index0 in part.bold %} class="changed"{% endif %}>
{%- for word in row %}{% if loop.first %}<th scope="row">{{ word }}</th>
{%- else %}<td{% if loop.index0 in part.left %} class="text"{% endif %}>{{ word }}</td>
{%- endif %}{% endfor %}</tr>
{%- endfor %}</tbody></table></div>
{%- elif part.kind == "heading" %}
<h3>{{ part.words }}</h3>
{%- elif part.kind == "key" %}
<p class="key">{% for colour, words in part.rows %}<span><span class="swatch"
 style="border-color: {{ colour }}"></span> {{ words }}</span> {% endfor %}</p>
{%- else %}
<p{% if part.kind == "note" %} class="note"{% endif %}>{{ part.words }}</p>
{%- endif %}{% endfor %}
</section>
{%- endfor %}
</main></body></html>
"""
