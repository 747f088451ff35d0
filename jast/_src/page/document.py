"""The skeleton of a page, its data, and what both must do with words that a user wrote."""

import json
import math
import os
from collections.abc import Iterable, Mapping
from html import escape
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jast._src.io.atomic import replacing

__all__ = ["document", "plain", "rows", "table", "text", "write"]

HERE = Path(__file__).parent
PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="generator" content="jast">
<title>{title}</title>
<style>
{style}</style>
</head>
<body>
{body}
<script type="application/json" id="data">{data}</script>
<script>
{script}</script>
</body>
</html>
"""


def document(title: str, body: str, data: Any, *scripts: str) -> str:
    """One HTML file.

    Args:
        title: of the window; escaped here.
        body: HTML, in which all words are escaped (`text`).
        data: what the scripts read: pytrees of dicts, lists, texts and numbers. NaN and infinity
            are texts there, as JSON has no such numbers.
        *scripts: names of files beside this one, in the order in which they run.
    """
    style, *code = (
        (HERE / name).read_text(encoding="utf-8") for name in ("page.css", "page.js", *scripts)
    )
    return PAGE.format(
        title=text(title), style=style, body=body, data=embedded(data), script="\n".join(code)
    )


def write(path: str | os.PathLike, page: str) -> None:
    """Write ``page`` to a file. The write is atomic: an existing file is replaced only once the new
    one is complete.
    """
    with replacing(path, "w", encoding="utf-8", errors="backslashreplace", newline="\n") as file:
        file.write(page)


def embedded(data: Any) -> str:
    """JSON that may stand in an HTML script: nothing in it ends the script."""
    words = json.dumps(plain(data), ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    return words.replace("</", "<\\/").replace("<!--", "\\u003c!--")


def plain(value: Any) -> Any:
    """``value`` as JSON has it, to the last bit; "NaN", "Infinity" and "-Infinity" are texts, which
    `float` and JavaScript's ``Number`` read.
    """
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return plain(np.asarray(value).tolist())
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else f"{'-' * (value < 0)}Infinity"
    return value


def text(value: Any) -> str:
    """Words as they are, whatever they hold: escaped for HTML."""
    return escape(str(value), quote=True)


def rows(pairs: Iterable[tuple[str, Any]], kind: str = "facts") -> str:
    """A list of names and what is to be said of them."""
    body = "".join(f"<dt>{text(name)}</dt><dd>{text(value)}</dd>" for name, value in pairs)
    return f'<dl class="{kind}">{body}</dl>'


def table(head: Iterable[str], body: Iterable[Iterable[Any]]) -> str:
    """A table; numbers stand right."""

    def cell(value: Any) -> str:
        number = isinstance(value, int | float | np.number)
        words = f"{value:.5g}" if isinstance(value, float) else text(value)
        return f"<td{' class=number' if number else ''}>{words}</td>"

    top = "".join(f"<th>{text(name)}</th>" for name in head)
    lines = "".join(f"<tr>{''.join(map(cell, line))}</tr>" for line in body)
    return f"<table><thead><tr>{top}</tr></thead><tbody>{lines}</tbody></table>"
