"""Figures for a page of one file: SVG that follows the page's colours, and pictures as text."""

from __future__ import annotations

import base64
import io
import re
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageSequence

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

WEBP_QUALITY = 42
"""Of pictures, out of 100; lines are still sharp."""

WIDEST = 240
"""Pixels of a panel's picture at most, which is shown about 150 wide."""


class Styles:
    """Names for the styles of a page's figures: each is written once, in one style element."""

    def __init__(self) -> None:
        self._names: dict[str, str] = {}
        self._n_ids = 0

    def name(self, style: str) -> str:
        """Return the class of a style, the same for the same."""
        return self._names.setdefault(style, f"f{len(self._names)}")

    def new_id(self) -> str:
        """Return an id that no other part of the page's figures has."""
        self._n_ids += 1
        return f"i{self._n_ids}"

    def css(self) -> str:
        """Return the classes' rules."""
        return "\n".join(f".{name}{{{style}}}" for style, name in self._names.items())


def inline_svg(figure: Figure, label: str, styles: Styles) -> str:
    """Return a figure as an SVG element for inside a page.

    Parameters
    ----------
    figure
        Of numbers.
    label
        What it shows, for those who do not see it; plain text.
    styles
        Of the page, which gets the figure's.
    """
    file = io.StringIO()
    # Text stays text: it can be searched, read out, and has the page's colours.
    with mpl.rc_context({"svg.hashsalt": "iflow-gym", "svg.fonttype": "none"}):
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    svg = file.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<!--.*?-->|<metadata>.*?</metadata>|<style.*?</style>", "", svg, flags=re.S)
    svg = re.sub(r"#[0-9a-fA-F]{6}\b", lambda m: VARIABLES.get(m[0].lower(), m[0]), svg)
    svg = re.sub(r"font-family:[^;\"]*;? ?", "", svg)  # the page's own
    svg = re.sub(r' style="([^"]+)"', lambda m: f' class="{styles.name(_tight(m[1]))}"', svg)
    svg = _numbers_shortened(_ids_renamed(svg, styles))
    svg = re.sub(r"\s*\n\s*", " ", svg)
    svg = re.sub(r' transform="rotate\(-0[^"]*"', "", svg)
    svg = re.sub(r"<defs></defs>|<g></g>", "", re.sub(r"> <", "><", svg))
    while (plain := re.sub(r"<g>((?:<(?!/?g\b)[^>]*>|[^<])*)</g>", r"\1", svg)) != svg:
        svg = plain  # groups without attributes that hold no groups
    width, height = re.search(r'viewBox="0 0 ([0-9.]+) ([0-9.]+)"', svg).groups()  # type: ignore[union-attr]
    opening = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" '
        f'aria-label="{_attribute(label)}" style="--natural: {float(width) * 4 / 3:.0f}px">'
    )
    return re.sub(r"^<svg[^>]*>", lambda _: opening, svg).strip()


def _ids_renamed(svg: str, styles: Styles) -> str:
    """Return an SVG with short ids that no other of the page has, and none that nothing names."""
    named = re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', svg)
    new = {one or other: styles.new_id() for one, other in dict.fromkeys(named)}
    svg = re.sub(r' id="([^"]+)"', lambda m: f' id="{new[m[1]]}"' if m[1] in new else "", svg)
    svg = re.sub(r'xlink:href="#([^"]+)"', lambda m: f'href="#{new[m[1]]}"', svg)
    return re.sub(r"url\(#([^)]+)\)", lambda m: f"url(#{new[m[1]]})", svg)


def _numbers_shortened(svg: str) -> str:
    """Return an SVG with coordinates to a tenth of a point, a quarter of a pixel at most."""

    def short(match: re.Match[str]) -> str:
        text = f"{float(match[0]):.1f}".rstrip("0").rstrip(".")
        return "0" if text in ("", "-0") else text

    def attribute(match: re.Match[str]) -> str:
        text = re.sub(r"-?\d+\.\d{2,}", short, match[2])
        if match[1] == 'd="':
            text = re.sub(r"\s*([A-Za-z])\s*", r"\1", text).replace(" -", "-")
        return f'{match[1]}{text}"'

    return re.sub(r'(\b(?:d|x|y|points|width|height)=")([^"]*)"', attribute, svg)


def _tight(style: str) -> str:
    return re.sub(r"\s*([:;])\s*", r"\1", style).rstrip(";")


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
        top, bottom = (round(len(pixels) - y) for y in (box.y1, box.y0))
        picture = Image.fromarray(pixels[max(top, 0) : bottom, max(left, 0) : right])
        picture.thumbnail((WIDEST, WIDEST), Image.Resampling.LANCZOS)
        pictures.append(webp(np.asarray(picture)))
    return pictures


def webp(pixels: NDArray[np.uint8]) -> str:
    """Return pixels, shape (height, width, 3), as the ``data:`` address of a WebP image."""
    file = io.BytesIO()
    image = Image.fromarray(np.ascontiguousarray(pixels))
    image.save(file, "WEBP", quality=WEBP_QUALITY, method=6)
    return data_address(file.getvalue(), "image/webp")


def moving_webp(path: Path) -> str:
    """Return a GIF's frames, at their pace and without an end, as the address of a WebP image."""
    with Image.open(path) as gif:
        frames, durations = [], []
        for frame in ImageSequence.Iterator(gif):
            frames.append(frame.convert("RGB"))
            durations.append(frame.info["duration"])
    file = io.BytesIO()
    frames[0].save(
        file, "WEBP", save_all=True, append_images=frames[1:], duration=durations, loop=0,
        quality=WEBP_QUALITY, method=4,
    )  # fmt: skip
    return data_address(file.getvalue(), "image/webp")


def data_address(content: bytes, kind: str) -> str:
    """Return bytes as an address that is its own content."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
