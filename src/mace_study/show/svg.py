"""A figure for the page: its panels one by one, as SVG that takes the page's colours."""

import re

import pandas as pd
from matplotlib.figure import Figure

from mace_study.config.metrics import FigureConfig
from mace_study.show.curves import PlotStyle, Quantity, draw_figure, figure_as_svg

WIDTH, HEIGHT = 3.3, 2.5  # inches: letters of a readable size on a phone
# What figures draw in black (seaborn: almost), light grey and white, in light and in dark.
PAGE_COLOURS = {"#000000": "currentColor", "#262626": "currentColor"}
PAGE_COLOURS |= {"#e6e6e6": "var(--line)", "#ffffff": "var(--card)"}


def panels(
    curves: pd.DataFrame, single_seeds: pd.DataFrame, shown: Quantity, look: PlotStyle
) -> dict[str, str]:
    """The panel of each environment, as `draw_figure` draws it; no legend."""
    drawn: dict[str, str] = {}
    for environment, own in curves.groupby("env", sort=False):
        seeds = single_seeds[single_seeds["env"] == environment]
        alone = look._replace(layout=FigureConfig(columns=1))
        figure = draw_figure(own, seeds, shown, alone)
        for legend in figure.legends:
            legend.remove()
        figure.set_size_inches(WIDTH, HEIGHT)
        drawn[str(environment)] = svg(figure, f"{shown.name}-{len(drawn)}", str(environment))
    return drawn


def svg(figure: Figure, name: str, label: str) -> str:
    """A figure as an SVG element whose ids begin with `name`."""
    text = figure_as_svg(figure)
    text = text[text.index("<svg") :].replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1)
    text = re.sub(r'(id="|href="#|url\(#)', rf"\g<1>{name}-", text)
    # A tenth of a point is a seventh of a pixel; the long decimals of paths are half the file.
    text = re.sub(r'(?<= d=")[^"]+', lambda path: re.sub(r"(\.\d)\d+", r"\1", path[0]), text)
    for colour, of_page in PAGE_COLOURS.items():
        text = text.replace(colour, of_page)
    return text
