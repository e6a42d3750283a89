"""Pictures of runs: learning curves, and of a run of GPO its family tree, parents and children, and states they visit.

One run: all that its folder has the data for. Several runs: their learning curves together, a panel per environment, a
curve per method and setting, a band over its seeds. PNG and SVG go to the (first) run's folder or to --output; those of one
finished run also into its TensorBoard events. Needs requirements-benchmark.txt.
Example: python -m benchmark.picture runs/HalfCheetah-v4__gpo_ppo__1__1700000000
"""

import json
import math
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Literal

import matplotlib
import tyro

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from matplotlib.collections import LineCollection  # noqa: E402
from matplotlib.ticker import EngFormatter  # noqa: E402
from PIL import Image  # noqa: E402
from torch.utils.tensorboard import SummaryWriter  # noqa: E402

import gpo_ppo  # noqa: E402
from benchmark import crossover  # noqa: E402
from benchmark import curves as learning  # noqa: E402
from benchmark.lineage import ancestry, read_lineage  # noqa: E402

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
PNG_BYTES = 300_000


NAMES = ("curves", "family_tree", "crossovers", "states")


@dataclass
class Args:
    runs: tyro.conf.Positional[list[Path]]
    """folders of runs, of any of the scripts"""
    output: Path | None = None
    """the folder for the pictures; default: that of the first run"""
    csv: Path | None = None
    """a file for the plotted curves, at every hundredth of the budget"""
    pictures: tuple[Literal[NAMES], ...] = NAMES
    """which to draw"""
    couple: int = 0
    """the couple of round one whose states are shown, counted from the fittest"""
    episodes: int = 100
    """roll-outs per policy for the states"""
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


def place(lineage, bold):
    """Where each policy stands in its generation, {id: x}, and the generations, so that edges cross little, bold ones least.

    Generations take turns in being ordered by the mean place of their relatives above, then below (Sugiyama et al. 1981).
    """
    size, first = len(lineage.rounds[0]), lineage.rounds[0][0]["id"]
    generations = [range(first - size, first)] + [[child["id"] for child in children] for children in lineage.rounds]
    parents = {child["id"]: child["parents"] for children in lineage.rounds for child in children}
    children = defaultdict(list)
    for child, couple in parents.items():
        for parent in couple:
            children[parent].append(child)
    x = {policy: place for generation in generations for place, policy in enumerate(generation)}

    def order(generation, relatives):
        def mean_place(policy):
            around = relatives.get(policy, [policy])
            around = bold.intersection(around) or around if policy in bold else around
            return sum(x[other] for other in around) / len(around)

        x.update({policy: place for place, policy in enumerate(sorted(generation, key=mean_place))})

    for _ in range(8):
        for generation in generations[-2::-1]:
            order(generation, children)
        for generation in generations[1:]:
            order(generation, parents)
    return x, generations


def birth_returns(lineage):
    """{id: return} right after crossover; of founders that bred, after their first mutation."""
    founders = {policy: ret for child in lineage.rounds[0] for policy, ret in zip(child["parents"], child["parent_returns"])}
    return founders | {child["id"]: child["child_return"] for children in lineage.rounds for child in children}


def draw_tree(lineage):
    """The family tree: rounds downwards, a node per policy, edges to both parents, the winner's ancestry in bold."""
    bold, returns = set().union(*ancestry(lineage)), birth_returns(lineage)
    x, generations = place(lineage, bold)
    y = {policy: depth for depth, generation in enumerate(generations) for policy in generation}
    width, height = max(4.0, 0.4 * len(generations[0])), max(2.5, 0.62 * len(generations))
    figure, axes = plt.subplots(figsize=(width + 1.6, height + 0.5), layout="constrained")
    edges = [(parent, child["id"]) for children in lineage.rounds for child in children for parent in child["parents"]]
    for color, linewidth, wanted in (("0.78", 0.6, False), ("0.1", 1.7, True)):
        lines = [[(x[a], y[a]), (x[b], y[b])] for a, b in edges if (b in bold) == wanted]
        axes.add_collection(LineCollection(lines, colors=color, linewidths=linewidth, zorder=1 + wanted))
    ids = [policy for generation in generations for policy in generation]
    colors = plt.get_cmap("viridis").with_extremes(bad="white")
    nodes = axes.scatter(
        *([x[i] for i in ids], [y[i] for i in ids]),
        **dict(c=[returns.get(i, np.nan) for i in ids], cmap=colors, plotnonfinite=True),
        **dict(s=[380 if i == lineage.winner else 210 for i in ids], edgecolors=["0.1" if i in bold else "0.78" for i in ids]),
        **dict(linewidths=[4 if i == lineage.winner else 1.7 if i in bold else 0.6 for i in ids], zorder=3),
    )
    for i in ids:
        dark = i in returns and nodes.norm(returns[i]) < 0.6
        axes.text(x[i], y[i], str(i), ha="center", va="center", fontsize=6, color="white" if dark else "black", zorder=4)
    rounds = [f"round {children[0]['round']}" for children in lineage.rounds]
    axes.set_yticks(range(len(generations)), ["founders", *rounds])
    axes.set(xticks=[], xlim=(-0.7, len(generations[0]) - 0.3), ylim=(len(generations) - 0.5, -0.5))
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.set_title(f"{'winner' if lineage.finished else 'best of the last round'} {lineage.winner}, its ancestry in bold")
    axes.set_xlabel("founders: coloured by the return with which they bred, white if they did not", fontsize=7)
    bar = figure.colorbar(nodes, shrink=0.8, aspect=30, pad=0.02)
    bar.set_label("Return after crossover")
    bar.outline.set_visible(False)
    return figure


def draw_crossovers(lineage):
    """Parents and children: a panel per round, a group of three bars per couple.

    As in the paper relative to the first parent, unless such a parent's return is not positive or near 0: then plain.
    """
    bars = [[[*child["parent_returns"], child["child_return"]] for child in children] for children in lineage.rounds]
    values, many = [np.array(triples) for triples in bars], len(bars[0]) > 16
    relative = all((returns[:, 0] > 0.1 * returns.max()).all() and returns[:, 0].min() > 0 for returns in values)
    width, height = max(2.2, (0.16 if many else 0.33) * len(bars[0])), 1.3 if many else 1.75  # inches
    columns = min(len(values), max(1, min(4, int(11 / width))))
    rows = math.ceil(len(values) / columns)
    shape = dict(figsize=(columns * width + 0.5, rows * height + 0.5), squeeze=False, sharey="row")
    figure, grid = plt.subplots(rows, columns, layout="constrained", **shape)
    for axes in grid.flat[len(values) :]:
        axes.set_visible(False)
    for axes, children, returns in zip(grid.flat, lineage.rounds, values):
        heights = returns / returns[:, :1] if relative else returns
        at = np.arange(len(children))
        for k, (name, color) in enumerate(zip(("first parent", "second parent", "child"), ("#56B4E9", "#0072B2", "#E69F00"))):
            axes.bar(at + 0.27 * (k - 1), heights[:, k], 0.27, color=color, label=name)
        axes.axhline(1 if relative else 0, color="0.3", linewidth=0.6)
        couples = ["{}+{}".format(*child["parents"]) for child in children]
        axes.set_xticks([] if many else at, [] if many else couples, rotation=90, fontsize=6)
        axes.tick_params(axis="y", labelsize=7)
        axes.tick_params(axis="x", length=0)
        better = int((returns[:, 2] >= returns[:, :2].max(1)).sum())
        axes.set_title(f"round {children[0]['round']}: {better} of {len(children)} as good as both", fontsize=8)
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    figure.supylabel("Return relative to the first parent" if relative else RETURN, fontsize=9)
    figure.supxlabel("Couple", fontsize=9)
    return figure


def visits(args, policy, stats, episodes):
    """Per member of a stack its roll-outs as (obs [L, obs_dim], return), `episodes` each, from the same starts and noise."""
    members = len(policy.flat)
    envs = gpo_ppo.make_envs(args, members * episodes)
    obs, _ = envs.reset(seed=gpo_ppo.env_seeds(episodes, args.seed, "states") * members)
    noise = gpo_ppo.normal_noise([gpo_ppo.rng(args.seed, "states", 1)], args.max_episode_steps, episodes, args.act_dim)
    act = gpo_ppo.sample_actions(policy, stats, noise)
    data = gpo_ppo.rollout(envs, obs.reshape(len(obs), -1), act, args.max_episode_steps)
    envs.close()
    first = [ended[0] for ended in gpo_ppo.finished_episodes([[] for _ in obs], data)]
    return [first[i * episodes : (i + 1) * episodes] for i in range(members)]


def embed(args, stats, rollouts, states=1000):
    """t-SNE of `states` states from the better half of each policy's roll-outs, all policies in one map [policies, n, 2]."""
    from sklearn.manifold import TSNE  # here, because it takes seconds to import

    samples = []
    for k, episodes in enumerate(rollouts):
        best = sorted(episodes, key=lambda episode: -episode[1])[: math.ceil(len(episodes) / 2)]
        obs = gpo_ppo.normalize(np.concatenate([obs for obs, _ in best])[None], stats)[0]
        samples.append(obs[gpo_ppo.rng(args.seed, "tsne", k).choice(len(obs), states, replace=len(obs) < states)])
    embedding = TSNE(init="pca", random_state=args.seed).fit_transform(np.concatenate(samples))
    return embedding.reshape(len(samples), states, 2)


def draw_states(run, couple, episodes):
    """The paper's state visitation: parents of one couple of round one, their child by either operator, mean returns above."""
    args, saved = crossover.load(run)
    if couple >= len(saved.couples):
        gpo_ppo.refuse(f"--couple {couple}: round one had {len(saved.couples)}, counted from 0")
    x, y = saved.couples[couple]
    policies = {f"first parent ({saved.ids[x]})": saved.parents[x], f"second parent ({saved.ids[y]})": saved.parents[y]}
    for kind in dict.fromkeys((args.crossover, "parameter")):
        policies[f"child, {kind}"] = crossover.children_of(args, saved, kind)[couple]
    stats = SimpleNamespace(mean=saved.mean.numpy()[None], inv_std=saved.inv_std.numpy()[None])
    with torch.no_grad():
        rollouts = visits(args, gpo_ppo.make_policy(torch.stack(list(policies.values())), args), stats, episodes)
    points = embed(args, stats, rollouts)

    figure, grid = plt.subplots(
        1, len(policies), figsize=(2.3 * len(policies), 2.8), layout="constrained", sharex=True, sharey=True
    )
    for axes, name, own, played, color in zip(grid, policies, points, rollouts, COLORS):
        axes.scatter(*points.reshape(-1, 2).T, s=2, color="0.88", linewidths=0, rasterized=True)
        axes.scatter(*own.T, s=4, color=color, linewidths=0, alpha=0.7, rasterized=True)
        axes.set_title(f"{name}\n{np.mean([ret for _, ret in played]):.0f}")
        axes.set(xticks=[], yticks=[], aspect="equal")
        axes.spines[:].set(visible=True, color="0.7")
    text = f"t-SNE of states in the better half of {episodes} roll-outs (grey: of all policies); above, mean return of all {episodes}"
    figure.supxlabel(text, fontsize=7)
    return figure


def add_to_events(run, folder, names):
    """Adds pictures to a finished run's TensorBoard events, in a file of their own that replaces that of an earlier call.

    A run that lasts is left alone: TensorBoard reads files by age, and does not come back to the one that still grows.
    """
    if not (run.folder / "evaluation.json").is_file():
        return
    for old in run.folder.glob("events.out.tfevents.*.pictures"):
        old.unlink()
    step = json.loads((run.folder / "evaluation.json").read_text())["global_step"]
    with SummaryWriter(run.folder, filename_suffix=".pictures") as writer:
        for name in names:
            image = np.asarray(Image.open(folder / f"{name}.png").convert("RGB"))
            writer.add_image(f"pictures/{name}", image, step, dataformats="HWC")


def add_to_wandb(run, folder, names):
    """Adds pictures to a finished run that Weights & Biases recorded offline; `wandb sync --append` sends them after it."""
    if not (run.folder / "evaluation.json").is_file() or not list(run.folder.glob("wandb/offline-run-*")):
        return
    import wandb

    step = json.loads((run.folder / "evaluation.json").read_text())["global_step"]
    settings = dict(project=run.flags["wandb_project_name"], entity=run.flags["wandb_entity"], id=run.folder.name)
    with wandb.init(
        **settings, mode="offline", dir=run.folder, settings=wandb.Settings(console="off", silent=True)
    ) as session:
        session.log({f"pictures/{name}": wandb.Image(str(folder / f"{name}.png")) for name in names}, step=step)


def save(figure, folder, name):
    """NAME.svg and NAME.png, the latter in 255 colours and as sharp as PNG_BYTES let it be; equal data give equal files."""
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
    for dpi in (150, 120, 100, 80, 60):
        figure.savefig(folder / f"{name}.png", dpi=dpi)
        Image.open(folder / f"{name}.png").convert("RGB").quantize(255).save(folder / f"{name}.png", optimize=True)
        if (folder / f"{name}.png").stat().st_size < PNG_BYTES:
            break
    plt.close(figure)
    print(f"{folder / name}.png and .svg")


def main(argv=None):
    """Draws and saves; returns the names of the pictures."""
    options = tyro.cli(Args, args=argv, description=__doc__)
    for flag, value, least in (("episodes", options.episodes, 1), ("couple", options.couple, 0)):
        if value < least:
            gpo_ppo.refuse(f"--{flag} {value}: must be >= {least}")
    runs = [learning.read_run(folder) for folder in dict.fromkeys(options.runs)]
    folder, output = runs[0].folder, options.output or runs[0].folder
    curves = learning.read_curves(runs, options.scalar)
    if options.csv:
        learning.write_csv(curves, options.csv)
        print(options.csv)
    torch.set_num_threads(1)
    pictures = {"curves": lambda: draw_curves(curves)}
    if len(runs) == 1 and (folder / "lineage.jsonl").is_file():
        lineage = read_lineage(folder)
        pictures |= {"family_tree": lambda: draw_tree(lineage), "crossovers": lambda: draw_crossovers(lineage)}
    if len(runs) == 1 and (folder / "crossover_001.pt").is_file():
        pictures["states"] = lambda: draw_states(folder, options.couple, options.episodes)
    names = [name for name in pictures if name in options.pictures]
    with plt.rc_context(STYLE):
        for name in names:
            save(pictures[name](), output, name)
    if len(runs) == 1:
        add_to_events(runs[0], output, names)
        add_to_wandb(runs[0], output, names)
    return names


if __name__ == "__main__":
    main()
