"""What a crossover does to policies: parents and their children by every operator, on the same episodes (the paper's bars).

Takes the parents that bred at the end of a GPO run's first round and the children that the run made of them, makes copy and
parameter children of the same couples, and plays them all. Returns are divided by the first parent's, as in the paper.
Example: python -m benchmark.crossover runs/HalfCheetah-v4__gpo_ppo__1__1700000000
"""

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
import tyro

import gpo_ppo


@dataclass
class Args:
    run: tyro.conf.Positional[Path]
    """the folder of a run of gpo_ppo.py or gpo_a2c.py that has crossover_001.pt"""
    episodes: int = 100
    """episodes of every policy, with sampled actions; all meet the same starts and the same noise"""
    output: Path | None = None
    """the folder for crossover.csv and crossover.json; default: the run's"""


def load(run):
    """The run's flags as a script has them, the couples, policies and normalizer of its first crossover."""
    path = run / "crossover_001.pt"
    if not path.is_file():
        gpo_ppo.refuse(f"{run}: there is no {path.name} in this folder; a GPO run writes it at the end of its first round")
    saved = torch.load(path, weights_only=True)
    args = SimpleNamespace(**saved["flags"])
    args.max_episode_steps = saved["max_episode_steps"]
    gpo_ppo.check_environment(args)
    return args, SimpleNamespace(**saved)


def children_of(args, saved, kind):
    """Policies [m, P] that an operator makes of the saved couples; those that the run made itself are taken as saved."""
    if kind == args.crossover:
        return saved.children
    settings = SimpleNamespace(**{**vars(args), "crossover": kind})
    parents = SimpleNamespace(policies=saved.parents, fitness=saved.fitness.numpy())
    slots = list(range(len(saved.couples)))
    return gpo_ppo.crossover(settings, saved.round - 1, slots, saved.couples, parents, None, None)[0]


def play(args, saved, policies, episodes):
    """Mean returns of policies [m, P] under the run's normalizer, [m]."""
    stats = SimpleNamespace(mean=saved.mean.numpy()[None], inv_std=saved.inv_std.numpy()[None])
    stats = SimpleNamespace(**{name: x.repeat(len(policies), axis=0) for name, x in vars(stats).items()})
    return gpo_ppo.evaluate(args, gpo_ppo.make_policy(policies, args), stats, "crossover benchmark", episodes).mean(1)


def compare(args, saved, episodes):
    """One row per couple: both parents' ids, everyone's mean return, and that relative to the first parent's.

    The ratio is None where the first parent's return is not positive: there a larger ratio would be worse.
    """
    x, y = np.array(saved.couples).T
    parents = play(args, saved, saved.parents, episodes)
    returns = {"first_parent": parents[x], "second_parent": parents[y]}
    for kind in ("state-space", "copy", "parameter"):
        if kind in (args.crossover, "copy", "parameter"):  # state-space children exist only if the run made them
            returns[kind] = play(args, saved, children_of(args, saved, kind), episodes)
    rows = []
    for k in range(len(x)):
        row = {"couple": k, "first_parent_id": saved.ids[x[k]], "second_parent_id": saved.ids[y[k]]}
        row |= {f"{name}_return": float(means[k]) for name, means in returns.items()}
        first = returns["first_parent"][k]
        row |= {f"{name}_relative": float(means[k] / first) if first > 0 else None for name, means in returns.items()}
        rows.append(row)
    return rows, list(returns)


def summarize(rows, names):
    """Per kind of child: the mean of its ratios, and the fraction of couples whose child is at least as good as both."""
    summary = {}
    for kind in names[2:]:
        ratios = [row[f"{kind}_relative"] for row in rows if row[f"{kind}_relative"] is not None]
        wins = [row[f"{kind}_return"] >= max(row["first_parent_return"], row["second_parent_return"]) for row in rows]
        summary[kind] = {"mean_relative": float(np.mean(ratios)) if ratios else None, "as_good_as_both": float(np.mean(wins))}
    return summary


def main(argv=None):
    """Prints and saves the comparison; returns the content of crossover.json."""
    options = tyro.cli(Args, args=argv, description=__doc__)
    if options.episodes < 1:
        gpo_ppo.refuse(f"--episodes {options.episodes}: must be > 0")
    torch.set_num_threads(1)
    args, saved = load(options.run)
    with torch.no_grad():
        rows, names = compare(args, saved, options.episodes)
    result = {"run": options.run.name, "env_id": args.env_id, "seed": args.seed, "episodes": options.episodes}
    result |= {"summary": summarize(rows, names), "couples": rows}

    def ratio(x):
        return " " * 7 + "-" if x is None else f"{x:8.2f}"

    print(f"{args.env_id}, mean of {options.episodes} episodes each; beside it, relative to the first parent")
    print("couple".ljust(12) + "".join(name.rjust(20) for name in names))
    for row in rows:
        couple = f"{row['first_parent_id']} + {row['second_parent_id']}"
        cells = (f"{row[name + '_return']:12.1f}{ratio(row[name + '_relative'])}" for name in names)
        print(couple.ljust(12) + "".join(cells))
    for kind, x in result["summary"].items():
        print(f"{kind}: mean ratio {ratio(x['mean_relative']).strip()}, as good as both parents {x['as_good_as_both']:.0%}")

    output = options.output or options.run
    output.mkdir(parents=True, exist_ok=True)
    with open(output / "crossover.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    (output / "crossover.json").write_text(json.dumps(result, indent=1) + "\n")
    return result


if __name__ == "__main__":
    main()
