"""Self-contained HTML: nothing fetched, light and dark, printable; good without its script."""

from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files

from rov_ident.reports.result import Result
from rov_ident.reports.table import Table

_ASSETS = files("rov_ident.reports")


def page(title: str, lead: str, sections: Sequence[str], footer: str) -> str:
    """The whole document; ``sections`` are HTML made by the functions below."""
    body = "".join(sections)
    return (
        "<!doctype html>\n<html lang='en'><head><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width, initial-scale=1'>"
        f"<title>{escape(title)}</title><style>{_asset('page.css')}</style></head><body>"
        f"<h1>{escape(title)}</h1><p class='lead'>{escape(lead)}</p>"
        f"{body}<footer><p>{escape(footer)}</p></footer>{_script(body)}</body></html>\n"
    )


def fragment(parts: Sequence[str]) -> str:
    """A piece of HTML for a notebook, in the notebook's own colours."""
    return f"<div class='rov-ident'><style>{_asset('fragment.css')}</style>{''.join(parts)}</div>"


def _asset(name: str) -> str:
    return (_ASSETS / name).read_text("utf-8")


def _script(body: str) -> str:
    """What makes charts of the curves of a page; nothing for one without."""
    if "class='curves'" not in body:
        return ""
    parts = (_asset("uplot/uPlot.iife.min.js"), _asset("page.js"))
    style = f"<style>{_asset('uplot/uPlot.min.css')}</style>"
    return style + "".join(f"<script>{part}</script>" for part in parts)


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


def beside_table(table: Sequence[str], *parts: Sequence[str]) -> str:
    """A table as wide as it is, and parts of a page beside it where there is room."""
    return beside(table, *parts).replace("'beside'", "'beside table'", 1)


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
    return Table("", head, rows, text).html()
