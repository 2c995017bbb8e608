"""The parts of a report, and the template that makes a page of them.

Plain HTML, no scripts, nothing loaded, good in print. Rendered by Jinja with everything escaped;
figures are data: addresses.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass, field

import numpy as np

from detect.comparison.report import number

_INCHES_PX = 96.0


@dataclass(frozen=True)
class Part:
    """A piece of a section: what the template makes of it is its `kind`."""

    kind: str
    words: str = ""
    address: str = ""
    width: int = 0
    height: int = 0
    caption: str = ""
    head: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    text: tuple[int, ...] = ()
    entries: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Section:
    """A section with its heading."""

    key: str
    name: str
    parts: list[Part] = field(default_factory=list)


def figure_part(svg: bytes, words: str) -> Part:
    """A figure with its caption; its size is what it was drawn in."""
    start = svg[:2000].decode()
    width, height = (
        float(start.split(f' {name}="')[1].split('pt"')[0]) / 72.0 * _INCHES_PX
        for name in ("width", "height")
    )
    return Part("figure", words, data_address(svg, "svg+xml"), round(width), round(height))


def data_address(content: bytes, kind: str) -> str:
    """An image as an address that holds it; `kind` is its type behind ``image/``."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def range_text(from_m: float | None, to_m: float | None) -> str:
    """A range of distances, open at an end that is None."""
    if from_m is None:
        return f"below {to_m:g}"
    return f"{from_m:g} and more" if to_m is None else f"{from_m:g} to {to_m:g}"


def scaled(value: float | None, factor: float, decimals: int) -> str:
    """A figure in another unit, or a dash where there is none."""
    return number(None if value is None else factor * value, decimals)


def share_text(value: float) -> str:
    """A share, or a dash where it is NaN."""
    return f"{value:.3f}" if np.isfinite(value) else "-"


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
{%- macro figure(drawing) %}
<figure><img src="{{ drawing.address }}" alt="{{ drawing.words }}"
 width="{{ drawing.width }}" height="{{ drawing.height }}">
<figcaption>{{ drawing.words }}</figcaption></figure>
{%- endmacro %}
{%- macro table(data) %}
<div class="wide" tabindex="0" role="region" aria-label="{{ data.caption }}"><table>
<caption>{{ data.caption }}</caption>
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
<dl class="figures">{% for name, value in part.entries %}
<div><dt>{{ name }}</dt><dd>{{ value }}</dd></div>{% endfor %}</dl>
{%- elif part.kind == "figure" %}{{ figure(part) }}
{%- elif part.kind == "table" %}{{ table(part) }}
{%- elif part.kind == "heading" %}
<h3>{{ part.words }}</h3>
{%- elif part.kind == "key" %}
<p class="key">{% for colour, words in part.entries %}<span><span class="swatch"
 style="border-color: {{ colour }}"></span> {{ words }}</span> {% endfor %}</p>
{%- elif part.kind == "settings" %}
<div class="wide" tabindex="0" role="region" aria-label="{{ part.caption }}"><table>
<caption>{{ part.caption }}</caption>
<thead><tr><th scope="col" class="text">setting</th><th scope="col">value</th>
<th scope="col">default</th></tr></thead>
<tbody>{% for name, value, usual in part.rows %}
<tr{% if value != usual and usual != "" %} class="changed"{% endif %}><th scope="row">{{ name }}</th>
<td>{{ value }}</td><td>{{ usual if value != usual else "" }}</td></tr>
{%- endfor %}</tbody></table></div>
{%- else %}
<p{% if part.kind == "note" %} class="note"{% endif %}>{{ part.words }}</p>
{%- endif %}{% endfor %}
</section>
{%- endfor %}
</main></body></html>
"""  # noqa: E501
