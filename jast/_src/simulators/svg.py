"""Small pictures of a plane as SVG text: lines, discs, shapes and words at places of it."""

from collections.abc import Iterable
from html import escape
from typing import NamedTuple

__all__ = ["BLUE", "GREEN", "GREY", "INK", "VERMILION", "Place", "Plane"]

BLUE, VERMILION, GREEN, GREY, INK = "#0072B2", "#D55E00", "#009E73", "#8A8A8A", "#222222"
Place = tuple[float, float]


class Plane(NamedTuple):
    """A part of a plane, x to the right and y up, as wide as ``width`` pixels."""

    low: Place
    high: Place
    width: float

    @property
    def scale(self) -> float:
        """Pixels a unit."""
        return self.width / (self.high[0] - self.low[0])

    def picture(self, *parts: str) -> str:
        """The SVG element with ``parts`` on it, the first one lowest."""
        height = self.scale * (self.high[1] - self.low[1])
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width:g} {height:.0f}"'
            f' width="100%" style="max-width:{self.width:g}px;background:#f2f5f7"'
            f' font-family="sans-serif" font-size="13">{"".join(parts)}</svg>'
        )

    def line(
        self,
        places: Iterable[Place],
        colour: str,
        width: float = 1.5,
        dash: str = "",
        opacity: float = 1.0,
    ) -> str:
        """A line through ``places``."""
        dashed = f' stroke-dasharray="{dash}"' if dash else ""
        dashed += f' stroke-opacity="{opacity:g}"' if opacity < 1 else ""
        return (
            f'<polyline points="{self._points(places)}" fill="none" stroke="{colour}"'
            f' stroke-width="{width:g}"{dashed}/>'
        )

    def shape(self, places: Iterable[Place], colour: str, edge: str | None = None) -> str:
        """A polygon; with an ``edge`` of a colour it is dashed."""
        rim = f' stroke="{edge}" stroke-width="1.5" stroke-dasharray="3 2"' if edge else ""
        return f'<polygon points="{self._points(places)}" fill="{colour}"{rim}/>'

    def circle(self, place: Place, radius: float, colour: str, opacity: float = 1.0) -> str:
        """A disc of ``radius`` in units of the plane."""
        x, y = self._at(place)
        return (
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius * self.scale:.1f}" fill="{colour}"'
            f' fill-opacity="{opacity:g}"/>'
        )

    def words(self, place: Place, text: str, colour: str, anchor: str = "start") -> str:
        """``text`` that starts (or ends: "end") at ``place``; escaped."""
        x, y = self._at(place)
        return (
            f'<text x="{x:.1f}" y="{y:.1f}" fill="{colour}" text-anchor="{anchor}">'
            f"{escape(text)}</text>"
        )

    def _at(self, place: Place) -> Place:
        return (place[0] - self.low[0]) * self.scale, (self.high[1] - place[1]) * self.scale

    def _points(self, places: Iterable[Place]) -> str:
        return " ".join(f"{x:.1f},{y:.1f}" for x, y in map(self._at, places))
