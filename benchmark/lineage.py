"""Who descends from whom in a run of GPO, in the terminal: per round parents, child and their returns; the winner's ancestry.

Example: python -m benchmark.lineage runs/HalfCheetah-v4__gpo_ppo__1__1700000000
"""

import json
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import tyro

import gpo_ppo

KEYS = {"id", "round", "slot", "global_step", "parents", "parent_returns", "child_return"}


@dataclass
class Args:
    run: tyro.conf.Positional[Path]
    """the folder of a run of gpo_ppo.py or gpo_a2c.py, finished or not"""


def read_lineage(folder):
    """rounds: per round its children in order of slots, as lines of lineage.jsonl; winner: the best member's id.

    While a run lasts, the winner is the child of its last round with the highest return.
    """
    path = folder / "lineage.jsonl"
    if not path.is_file():
        gpo_ppo.refuse(f"{folder}: there is no {path.name} in this folder; a GPO run writes it at the end of its first round")
    rounds = {}
    for number, text in enumerate(path.read_text().splitlines(), 1):
        try:
            child = json.loads(text)
            if not KEYS <= set(child):
                raise ValueError
        except (ValueError, TypeError):
            gpo_ppo.refuse(f"{path}: line {number} is not one of a GPO run's children")
        rounds.setdefault(child["round"], []).append(child)
    if not rounds:
        gpo_ppo.refuse(f"{path}: there are no children yet")
    lineage = SimpleNamespace(rounds=list(rounds.values()), finished=(folder / "evaluation.json").is_file())
    if lineage.finished:
        lineage.evaluation = json.loads((folder / "evaluation.json").read_text())
        lineage.winner = lineage.evaluation["best_id"]
    else:
        lineage.winner = max(lineage.rounds[-1], key=lambda child: np.nan_to_num(child["child_return"], nan=-np.inf))["id"]
    return lineage


def ancestry(lineage):
    """The winner and its ancestors as sets of ids: first the founders', last the winner's own round."""
    generations = [{lineage.winner}]
    for children in reversed(lineage.rounds):
        generations.append({parent for child in children if child["id"] in generations[-1] for parent in child["parents"]})
    return generations[::-1]


def show(lineage):
    """The lines of the report."""
    ancestors = ancestry(lineage)
    for generation, children in enumerate(lineage.rounds):
        yield f"round {children[0]['round']}, {children[0]['global_step']:,} steps"
        yield f"{'parents':>15}{'returns of parents':>24}{'child':>10}{'return':>10}{'above the better':>20}"
        for child in children:
            x, y = child["parents"]
            before, after = child["parent_returns"], child["child_return"]
            mark = " *" if child["id"] in ancestors[generation + 1] else ""
            returns = f"{before[0]:>14.1f}{before[1]:>10.1f}{child['id']:>10}{after:>10.1f}{after - max(before):>+20.1f}"
            yield f"{f'{x} + {y}':>15}{returns}{mark}"
        better = sum(child["child_return"] >= max(child["parent_returns"]) for child in children)
        yield f"{better} of {len(children)} children at least as good as both parents\n"

    if lineage.finished:
        result = lineage.evaluation
        episodes = f"{result['report_episodes']} episodes"
        yield f"the winner is {lineage.winner}, return {result['best']:.1f} +- {result['best_std']:.1f} over {episodes}"
    else:
        yield f"the best of the last round is {lineage.winner}; the run has not ended"
    yield "its ancestry, marked * above:"
    for generation, ids in enumerate(ancestors):
        name = f"round {lineage.rounds[generation - 1][0]['round']}" if generation else "founders"
        yield f"{name:>10}: {', '.join(map(str, sorted(ids)))}"


def main(argv=None):
    """Prints the report."""
    options = tyro.cli(Args, args=argv, description=__doc__)
    for line in show(read_lineage(options.run)):
        print(line)


if __name__ == "__main__":
    main()
