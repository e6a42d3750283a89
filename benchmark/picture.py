"""Pictures of runs: learning curves, and of a run of GPO its family tree, parents and children, and states they visit.

One run: all that its folder has the data for. Several runs: their learning curves together, a panel per environment, a
curve per method and setting, a band over its seeds. PNG and SVG go to the (first) run's folder or to --output; those of one
finished run also into its TensorBoard events. Needs requirements-benchmark.txt.
Example: python -m benchmark.picture runs/HalfCheetah-v4__gpo_ppo__1__1700000000
"""

import math
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import tyro

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
from matplotlib.ticker import EngFormatter  # noqa: E402

from benchmark import curves as learning  # noqa: E402

# Okabe and Ito's colours, which most colour-blind people tell apart; line styles say the same once more.
COLORS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000"]
DASHES = ["-", "--", "-.", ":"]
STYLE = {
    **{
        "font.size": 9,
        "axes.titlesize": 9,
        "axes.labelsize": 9,
        "legend.fontsize": 8,
        "legend.title_fontsize": 8,
        "legend.frameon": False,
    },
    **{"axes.spines.top": False, "axes.spines.right": False, "axes.grid": False, "svg.hashsalt": "gpo"},
}
RETURN = "Return of an episode"


@dataclass
class Args:
    runs: tyro.conf.Positional[list[Path]]
    """folders of runs, of any of the scripts"""
    output: Path | None = None
    """the folder for the pictures; default: that of the first run"""
    csv: Path | None = None
    """a file for the plotted curves, at every hundredth of the budget"""
    scalar: str = learning.MEAN
    """the TensorBoard scalar on the learning curves' y-axis; default: the mean return of all members"""


def draw_curves(curves):
    """Learning curves: a panel per environment, the legend above all."""
    panels = list(dict.fromkeys(curve.env_id for curve in curves))
    looks = {label: k for k, label in enumerate(dict.fromkeys(curve.label for curve in curves))}
    columns = min(3, len(panels))
    rows = math.ceil(len(panels) / columns)
    size = (5.2, 3.8) if len(panels) == 1 else (3.4 * columns, 2.6 * rows + 0.8)
    figure, grid = plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
    lines = {}
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    for curve in curves:
        axes, look = grid.flat[panels.index(curve.env_id)], looks[curve.label]
        color, dashes = COLORS[look % len(COLORS)], DASHES[look % len(DASHES)]
        (lines[curve.label],) = axes.plot(curve.steps, curve.mean, dashes, color=color, linewidth=1.6)
        axes.fill_between(curve.steps, curve.low, curve.high, color=color, alpha=0.2, linewidth=0)
        axes.set_title(curve.env_id)
        axes.set_xlim(left=0)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    texts = [f"{label}, {seeds_text(curves, label)}" for label in lines]
    columns = min(len(lines), 3 if max(map(len, texts)) < 32 else 1)
    figure.legend(lines.values(), texts, loc="outside upper center", ncols=columns, title=band_text(curves))
    figure.supxlabel("Environment steps of the whole run", fontsize=9)
    figure.supylabel(RETURN, fontsize=9)
    return figure


def seeds_text(curves, label):
    """How many seeds are behind a label; a range if panels differ."""
    counts = sorted({curve.seeds for curve in curves if curve.label == label})
    return " to ".join(str(count) for count in dict.fromkeys([counts[0], counts[-1]])) + (
        " seed" if counts == [1] else " seeds"
    )


def band_text(curves):
    """What lines and bands show, for the legend."""
    bands = {curve.band for curve in curves}
    if "deviation of seeds" in bands:
        return "mean and standard deviation over seeds"
    return "mean of members, band from worst to best" if "worst to best member" in bands else None


def save(figure, folder, name):
    """NAME.png and NAME.svg; the same data give the same files."""
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / f"{name}.png", dpi=150)
    figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
    plt.close(figure)
    print(f"{folder / name}.png and .svg")


def main(argv=None):
    """Draws and saves; returns the names of the pictures."""
    options = tyro.cli(Args, args=argv, description=__doc__)
    runs = [learning.read_run(folder) for folder in dict.fromkeys(options.runs)]
    output = options.output or runs[0].folder
    curves = learning.read_curves(runs, options.scalar)
    if options.csv:
        learning.write_csv(curves, options.csv)
        print(options.csv)
    with plt.rc_context(STYLE):
        save(draw_curves(curves), output, "curves")


if __name__ == "__main__":
    main()
