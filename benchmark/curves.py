"""Learning curves out of runs' TensorBoard events: one curve per method and setting, a band over its seeds, CSV.

Nothing here draws (`benchmark.picture` does), so this part needs no package beyond the scripts' own.
"""

import csv
import json
from collections import defaultdict
from types import SimpleNamespace

import numpy as np
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import gpo_ppo

POINTS = 100
METHODS = {
    f"{name.lower()}_{algo.lower()}": f"{name} ({algo})" for name in ("GPO", "Single", "Joint") for algo in ("PPO", "A2C")
}
NO_SETTING = {"seed", "exp_name", "versions", "env_id", "max_restarts", *gpo_ppo.MAY_CHANGE_ON_RESUME}
MEAN, WORST, BEST = "charts/episodic_return", "population/min_return", "population/best_return"


def read_run(folder):
    """A run's folder, flags and name (gpo_ppo, single_a2c, ...); refuses a folder that no script made."""
    if not folder.is_dir():
        gpo_ppo.refuse(f"{folder}: there is no such folder")
    try:
        flags = json.loads((folder / "args.json").read_text())
        parts = folder.name.split("__")  # {env_id}__{exp_name}__{seed}__{time}, unless --run-name said otherwise
        name = flags["exp_name"] or (parts[-3] if len(parts) >= 4 else folder.name)
        return SimpleNamespace(folder=folder, flags=flags, name=name, env_id=flags["env_id"], seed=flags["seed"])
    except FileNotFoundError:
        gpo_ppo.refuse(f"{folder}: there is no args.json in this folder; it is not a run's")
    except (ValueError, KeyError, TypeError, AttributeError):
        gpo_ppo.refuse(f"{folder}: args.json does not hold the flags of a run")


def read_scalar(folder, tag):
    """One scalar of a run: steps [N] and values [N], in order of steps, over all of its event files."""
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0}).Reload()
    if tag not in events.Tags()["scalars"]:
        gpo_ppo.refuse(f"{folder}: its TensorBoard events have no scalar {tag} (yet)")
    points = sorted({event.step: event.value for event in events.Scalars(tag)}.items())
    return np.array(points, float).T


def grid(budget):
    """The steps [100] at which curves are given: every hundredth of the budget."""
    return budget * np.arange(1, POINTS + 1) / POINTS


def resample(steps, values, at):
    """Mean of what was logged since the grid point before, for each grid point [100].

    Where nothing was (a crossover takes a while) it is interpolated; NaN before the first value and after the last.
    """
    bins = np.searchsorted(at, steps - 1e-6)
    inside = bins < len(at)
    bins, values = bins[inside], values[inside]
    counts = np.bincount(bins, minlength=len(at))
    filled = np.flatnonzero(counts)
    means = np.bincount(bins, values, minlength=len(at))[filled] / counts[filled]
    return np.interp(np.arange(len(at)), filled, means, left=np.nan, right=np.nan)


def labels(runs):
    """What tells each run's curve from others in its panel: the method, and the flags in which its runs differ."""
    siblings = defaultdict(list)
    for run in runs:
        siblings[run.env_id, run.name].append(run)
    texts = {}
    for (_, name), group in siblings.items():
        flags = {flag for run in group for flag in run.flags} - NO_SETTING
        differ = sorted(flag for flag in flags if len({str(run.flags.get(flag)) for run in group}) > 1)
        for run in group:
            texts[run.folder] = ", ".join([METHODS.get(name, name)] + [f"{flag}={run.flags.get(flag)}" for flag in differ])
    return texts


def read_curves(runs, tag=MEAN):
    """Curves of runs, in the runs' order: env_id, label, seeds, band, and steps, mean, low, high [100].

    The band is one standard deviation of the seeds; of a run alone, the range of its members' returns.
    """
    texts, groups = labels(runs), defaultdict(list)
    for run in runs:
        groups[run.env_id, texts[run.folder]].append(run)
    curves = []
    for (env_id, label), group in groups.items():
        at = grid(group[0].flags["total_timesteps"])

        def read(tag, group=group, at=at):
            return np.stack([resample(*read_scalar(run.folder, tag), at) for run in group])

        values = read(tag)
        curve = SimpleNamespace(env_id=env_id, label=label, seeds=len(group), steps=at, mean=values.mean(0))
        if len(group) > 1:
            deviation = values.std(0, ddof=1)
            curve.low, curve.high, curve.band = curve.mean - deviation, curve.mean + deviation, "deviation of seeds"
        elif len(runs) == 1 and tag == MEAN:
            curve.low, curve.high, curve.band = read(WORST)[0], read(BEST)[0], "worst to best member"
        else:
            curve.low, curve.high, curve.band = curve.mean, curve.mean, "none"
        curves.append(curve)
    return curves


def write_csv(curves, path):
    """One row per curve and grid point; points that a curve has not reached are left out."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["env_id", "curve", "seeds", "band", "steps", "mean", "low", "high"])
        for curve in curves:
            for steps, *values in zip(curve.steps, curve.mean, curve.low, curve.high):
                if np.isfinite(values).all():
                    numbers = [f"{steps:.0f}", *(f"{value:.6g}" for value in values)]
                    writer.writerow([curve.env_id, curve.label, curve.seeds, curve.band, *numbers])
