"""Self-contained HTML reports: no script, nothing fetched, light and dark, printable."""

from collections.abc import Mapping, Sequence
from html import escape

from rov_ident.result import Result

_STYLE = """
:root { color-scheme: light dark; --ink: #1b1f24; --paper: #fff; --line: #d6dae0; --soft: #5b6470;
  --panel: #f5f7f9; }
@media screen and (prefers-color-scheme: dark) {
  :root { --ink: #e6e9ee; --paper: #14171b; --line: #343a42; --soft: #9aa4b1; --panel: #1c2026;
    --colour-0: #56a8e8; --colour-1: #f0803c; --colour-2: #2cc295; --colour-3: #e09cc0; }
}
* { box-sizing: border-box; }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper);
  max-width: 76rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; line-height: 1.25; } h2 { font-size: 1.15rem; margin: 2.2rem 0 .5rem; }
h3 { font-size: 1rem; margin: 0 0 .4rem; }
p.lead { font-size: 1.15rem; } p, figcaption, li { max-width: 48rem; } ul { padding-left: 1.2rem; }
figcaption, footer, .soft { color: var(--soft); } footer { margin-top: 3rem; font-size: .85rem;
  overflow-wrap: anywhere; }
figure { margin: .5rem 0 1rem; } figure svg { width: 100%; height: auto; display: block; }
figure > svg { max-width: 60rem; } figure text { fill: currentColor; }
.panels { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(21rem, 100%), 1fr));
  gap: .6rem 1.2rem; }
.panels.wide { grid-template-columns: repeat(auto-fit, minmax(min(29rem, 100%), 1fr)); }
.beside { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(26rem, 100%), 1fr));
  gap: 0 2rem; align-items: start; }
.beside > * { min-width: 0; } .beside h2 { margin-top: 1.2rem; }
.legend { display: flex; flex-wrap: wrap; gap: .2rem 1.4rem; margin: .3rem 0; }
.legend svg { width: 2rem; height: .7rem; margin-right: .4rem; display: inline-block; }
.card { border: 1px solid var(--line); border-radius: 8px; padding: .9rem 1.1rem; margin: .8rem 0; }
.card p { margin: .4rem 0; }
pre { background: var(--panel); border-radius: 8px; padding: .8rem 1rem; margin: .5rem 0;
  overflow-x: auto; font: 13px/1.45 ui-monospace, monospace; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .7rem; border-bottom: 1px solid var(--line); text-align: right;
  white-space: nowrap; }
th:first-child, td:first-child, td.text, th.text { text-align: left; }
@media screen and (max-width: 600px) { th, td { padding: .2rem .3rem; font-size: .8rem; }
  th, td:first-child { white-space: normal; } td:first-child { min-width: 5rem; } }
@media print { body { margin: 0; max-width: none; font-size: 10pt; }
  figure.one, .panels > svg, .card, pre, tr { break-inside: avoid; }
  h2, .legend { break-after: avoid; }
  .panels, .panels.wide, .beside { grid-template-columns: 1fr 1fr; }
  .beside .panels { grid-template-columns: 1fr; }
  th, td { padding: .15rem .4rem; font-size: 8.5pt; }
  footer { margin-top: 1rem; } .scroll, pre { overflow: visible; }
  pre { white-space: pre-wrap; font-size: 7.5pt; } }
"""


def page(title: str, lead: str, sections: Sequence[str], footer: str) -> str:
    """The whole document; ``sections`` are HTML made by the functions below."""
    return (
        "<!doctype html>\n<html lang='en'><head><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width, initial-scale=1'>"
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head><body>"
        f"<h1>{escape(title)}</h1><p class='lead'>{escape(lead)}</p>"
        f"{''.join(sections)}<footer><p>{escape(footer)}</p></footer></body></html>\n"
    )


def heading(text: str) -> str:
    return f"<h2>{escape(text)}</h2>"


def paragraph(text: str) -> str:
    return f"<p>{escape(text)}</p>"


def figure(svg: str, caption: str) -> str:
    return f"<figure>{svg}<figcaption>{escape(caption)}</figcaption></figure>"


def panels(svgs: Sequence[str], caption: str, wide: bool = False) -> str:
    """Small pictures side by side, as many as the page has room for."""
    kind = "panels wide" if wide else "panels"
    return (
        f"<figure><div class='{kind}'>{''.join(svgs)}</div>"
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def legend(entries: Mapping[str, tuple[str, str, float]]) -> str:
    """Lines and what they mean: label -> (CSS colour, stroke-dasharray, opacity)."""
    spans = "".join(
        "<span><svg viewBox='0 0 32 10' aria-hidden='true'><path d='M0 5H32' stroke-width='3' "
        f"style='stroke:{colour}' stroke-dasharray='{dashes}' opacity='{opacity:g}'/></svg>"
        f"{escape(label)}</span>"
        for label, (colour, dashes, opacity) in entries.items()
    )
    return f"<div class='legend'>{spans}</div>"


def beside(*parts: Sequence[str]) -> str:
    """Parts of a page side by side where there is room."""
    return "<div class='beside'>" + "".join(f"<div>{''.join(p)}</div>" for p in parts) + "</div>"


def card(title: str, parts: Sequence[str]) -> str:
    """A framed part of the page."""
    return f"<section class='card'><h3>{escape(title)}</h3>{''.join(parts)}</section>"


def code(text: str) -> str:
    """Text as it stands in a file."""
    return f"<pre>{escape(text)}</pre>"


def bullets(items: Sequence[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(item)}</li>" for item in items) + "</ul>"


def numbers(result: Result) -> str:
    """The numbers of a result with their 95 % intervals."""
    columns = (result.values, result.std, result.lower, result.upper)
    rows = [
        [name, f"{value:.5g}", f"{std:.2g}", f"{lower:.5g}", f"{upper:.5g}", unit]
        for name, unit, value, std, lower, upper in zip(result.names, result.units, *columns)
    ]
    return table(["", "value", "std", "95 % from", "to", "unit"], rows, text=[5])


def origin(result: Result) -> str:
    """The foot of a page: from which version and which files."""
    made = result.provenance
    files = (f"{bag['file']} {bag['sha256'][:12]}" for bag in made["bags"])
    return f"rov_ident {made['version']}; {', '.join(files)}"


def table(head: Sequence[str], rows: Sequence[Sequence[str]], text: Sequence[int] = ()) -> str:
    """Cells as text; the first column and those numbered in ``text`` are left-aligned."""
    start = ["<t{} class='text'>" if i in text else "<t{}>" for i in range(len(head))]
    top = "".join(s.format("h") + escape(cell) + "</th>" for s, cell in zip(start, head))
    body = "".join(
        "<tr>"
        + "".join(s.format("d") + escape(cell) + "</td>" for s, cell in zip(start, row))
        + "</tr>"
        for row in rows
    )
    inside = f"<thead><tr>{top}</tr></thead><tbody>{body}</tbody>"
    return f"<div class='scroll'><table>{inside}</table></div>"
