"""Figures for a page of one file: SVG that follows the page's colours, and pictures as text."""

from __future__ import annotations

import base64
import io
import re
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from iflow_gym.figures import PALETTE, REFERENCE_COLOUR
from iflow_gym.plotting import INK

VARIABLES = {
    INK: "var(--ink)",
    REFERENCE_COLOUR: "var(--figure-reference)",
    "#e6e2d8": "var(--figure-grid)",
    "#b5afa2": "var(--figure-axis)",
    "#000000": "var(--ink)",
    "#ffffff": "var(--card)",
    **{colour: f"var(--method-{i})" for i, colour in enumerate(PALETTE)},
}
"""Colours of the figures to the page's, which are other ones in the dark."""

WEBP_QUALITY = 62


def inline_svg(figure: Figure, name: str, label: str) -> str:
    """Return a figure as an SVG element for inside a page.

    Parameters
    ----------
    figure
        Of numbers.
    name
        Prefix of its ids, of letters, digits and "-"; unique in the page.
    label
        What it shows, for those who do not see it; plain text.
    """
    file = io.StringIO()
    # Text stays text: it can be searched, read out, and has the page's colours.
    with mpl.rc_context({"svg.hashsalt": "iflow-gym", "svg.fonttype": "none"}):
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    svg = file.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<!--.*?-->|<metadata>.*?</metadata>|<style.*?</style>", "", svg, flags=re.S)
    svg = re.sub(r"#[0-9a-fA-F]{6}\b", lambda m: VARIABLES.get(m[0].lower(), m[0]), svg)
    svg = re.sub(r"font: [^;\"]*?([0-9.]+)px[^;\"]*", r"font-size: \1px", svg)
    svg = _numbers_shortened(_ids_prefixed(svg, name))
    svg = re.sub(r"\s*\n\s*", " ", svg)
    svg = re.sub(r"> <", "><", svg)
    width, height = re.search(r'viewBox="0 0 ([0-9.]+) ([0-9.]+)"', svg).groups()  # type: ignore[union-attr]
    opening = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" '
        f'aria-label="{_attribute(label)}" style="--natural: {float(width) * 4 / 3:.0f}px">'
    )
    return re.sub(r"^<svg[^>]*>", lambda _: opening, svg).strip()


def _ids_prefixed(svg: str, name: str) -> str:
    """Return an SVG whose ids no other figure of the page has, without those that nothing names."""
    named = set(re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', svg))
    kept = {first or second for first, second in named}

    def mark(match: re.Match[str]) -> str:
        return f' id="{name}-{match[1]}"' if match[1] in kept else ""

    svg = re.sub(r' id="([^"]+)"', mark, svg)
    svg = re.sub(r'xlink:href="#', f'href="#{name}-', svg)
    return re.sub(r"url\(#", f"url(#{name}-", svg)


def _numbers_shortened(svg: str) -> str:
    """Return an SVG with coordinates to a hundredth of a point, which nobody sees."""

    def short(match: re.Match[str]) -> str:
        text = f"{float(match[0]):.2f}".rstrip("0").rstrip(".")
        return "0" if text in ("", "-0") else text

    def attribute(match: re.Match[str]) -> str:
        return match[1] + re.sub(r"-?\d+\.\d{3,}", short, match[2]) + '"'

    return re.sub(r'(\b(?:d|x|y|points|width|height)=")([^"]*)"', attribute, svg)


def _attribute(text: str) -> str:
    return (
        text.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;").replace(">", "&gt;")
    )


def panel_pictures(figure: Figure, n: int) -> list[str]:
    """Return the first n axes of a sheet as pictures, without their titles.

    Returns
    -------
    list of str
        ``data:`` addresses of WebP images.
    """
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[..., :3]
    pictures = []
    for ax in figure.axes[:n]:
        box = ax.get_window_extent()
        left, right = int(np.floor(box.x0)), int(np.ceil(box.x1))
        top, bottom = (int(round(len(pixels) - y)) for y in (box.y1, box.y0))
        pictures.append(webp(pixels[max(top, 0) : bottom, max(left, 0) : right]))
    return pictures


def webp(pixels: NDArray[np.uint8]) -> str:
    """Return pixels, shape (height, width, 3), as the ``data:`` address of a WebP image."""
    file = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(
        file, "WEBP", quality=WEBP_QUALITY, method=6
    )
    return data_address(file.getvalue(), "image/webp")


def data_address(content: bytes, kind: str) -> str:
    """Return bytes as an address that is its own content."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
