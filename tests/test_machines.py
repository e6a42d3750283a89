"""Several machines: two launches by torchrun on this one, joined through a rendezvous on the loopback interface."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import read_run

import gpo_ppo

ROOT = Path(__file__).parent.parent


@pytest.fixture
def machine(tmp_path):
    """machine(index, words, workers): one of two launches of gpo_ppo.py; index 0 hosts the rendezvous. All die with the test."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    launches = []

    def start(index, words, workers=1, name="shared"):
        settings = f"is_host={int(index == 0)},keep_alive_interval=1,keep_alive_max_attempt=3,join_timeout=300"
        command = [sys.executable, "-m", "torch.distributed.run", "--nnodes", "2", "--nproc-per-node", str(workers)]
        command += ["--rdzv-backend", "c10d", "--rdzv-endpoint", f"localhost:{port}", "--rdzv-conf", settings]
        command += ["--rdzv-id", name, "--max-restarts", "3" if name == "restarts" else "0", str(ROOT / "gpo_ppo.py"), *words]
        log = open(tmp_path / f"machine_{index}_{len(launches)}.log", "w+")
        # By default torch 2.13 keeps the first round's address, which a machine that comes anew then never learns.
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "TORCH_DISABLE_SHARE_RDZV_TCP_STORE": "1"}
        launch = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, cwd=tmp_path, env=environment)
        launch.said = lambda: Path(log.name).read_text()
        launches.append(launch)
        return launch

    yield start
    for launch in launches:
        launch.kill()
        launch.wait()


def without_workers(words):
    at = words.index("--workers")
    return words[:at] + words[at + 2 :]


def refusals(launch, timeout=120):
    """A launch that ends in failure: its workers' lines about it."""
    assert launch.wait(timeout) != 0
    return re.findall(r"^gpo_ppo\.py: error: (.*)$", launch.said(), re.MULTILINE)


def wait_for(condition, launches, timeout=120):
    """Waits until condition() holds; fails if a launch ends before, or the time does."""
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, [launch.said() for launch in launches]
        assert all(launch.poll() is None for launch in launches), [launch.said() for launch in launches]
        time.sleep(0.05)


def test_two_machines_give_the_numbers_of_one_process(machine, tiny, base_run, assert_same_run, tmp_path):
    """The folder is named by --rdzv-id; the two machines take 2 and 1 of the 3 members."""
    words = without_workers(tiny(tmp_path / "runs", population=3, total_timesteps=2400))
    launches = [machine(index, words) for index in (0, 1)]
    assert [launch.wait(120) for launch in launches] == [0, 0], [launch.said() for launch in launches]
    assert "2 worker(s)" in launches[0].said() + launches[1].said()
    run = read_run(tmp_path / "runs" / "shared")
    assert_same_run(base_run, run)
    assert not list(run.folder.glob(".token*")) and len(list(run.folder.glob("events*"))) == 1


@pytest.mark.slow
def test_a_machine_that_is_killed_and_comes_back_changes_nothing(machine, tiny, train, assert_same_run, tmp_path):
    """SIGKILL for the launcher of the second machine in the middle; the first waits for it, and both go on."""
    changes = {"population": 5, "rounds": 6, "total_timesteps": 12_000}
    words = without_workers(tiny(tmp_path / "runs", **changes))
    first, second = (machine(index, words, workers=2, name="restarts") for index in (0, 1))
    lineage = tmp_path / "runs" / "restarts" / "lineage.jsonl"
    wait_for(lambda: lineage.exists() and len(lineage.read_text().splitlines()) >= 10, [first, second], 300)
    second.send_signal(signal.SIGKILL)
    second.wait()
    assert not (lineage.parent / "evaluation.json").exists()
    time.sleep(2)
    again = machine(1, words, workers=2, name="restarts")
    assert [launch.wait(300) for launch in (first, again)] == [0, 0], [launch.said() for launch in (first, again)]
    assert first.said().count("4 worker(s)") + again.said().count("4 worker(s)") + second.said().count("4 worker(s)") == 2
    assert_same_run(train(tmp_path / "one", **changes), read_run(lineage.parent))


@pytest.mark.slow
def test_machines_that_see_different_folders_are_refused(machine, tiny, tmp_path):
    launches = [machine(index, without_workers(tiny(tmp_path / f"runs{index}"))) for index in (0, 1)]
    for index, launch in enumerate(launches):
        (line,) = refusals(launch)
        assert line.startswith(f"--run-dir {tmp_path / f'runs{index}'}: not one folder for all machines")
    written = [path.name for index in (0, 1) for path in (tmp_path / f"runs{index}").rglob("*") if path.is_file()]
    assert written == [".lock"]


@pytest.mark.slow
def test_machines_that_disagree_on_a_flag_are_refused(machine, tiny, tmp_path):
    words = [without_workers(tiny(tmp_path, population=4, seed=seed)) for seed in (5, 6)]
    launches = [machine(index, words[index], workers=2) for index in (0, 1)]
    for launch in launches:
        (line,) = refusals(launch)
        assert re.match(r"--seed: [56] for worker 0, [56] for worker [123]; give all machines the same flags", line)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "words", "message"),
    [
        ({"population": 3}, [], "--workers 4: more than --population 3"),
        ({}, ["--workers", "2"], "--workers 2: torchrun starts 4"),
    ],
)
def test_ranks_that_do_not_fit_are_refused(machine, tiny, tmp_path, changes, words, message):
    words = [*without_workers(tiny(tmp_path, **{"population": 8, **changes})), *words]
    for launch in [machine(index, words, workers=2) for index in (0, 1)]:
        (line,) = refusals(launch)
        assert line.startswith(message)


def under_torchrun(monkeypatch, run_id, ranks=1):
    for name, value in {"TORCHELASTIC_RUN_ID": run_id, "WORLD_SIZE": ranks, "RANK": 0, "LOCAL_RANK": 0}.items():
        monkeypatch.setenv(name, str(value))


def test_names_and_numbers_come_from_torchrun(tiny, tmp_path, monkeypatch, capsys):
    words = without_workers(tiny(tmp_path, population=3))
    under_torchrun(monkeypatch, "job-17", ranks=3)
    args = gpo_ppo.parse_args(words)
    assert (args.run_name, args.workers, args.resume) == ("job-17", 3, None)
    assert gpo_ppo.parse_args([*words, "--run-name", "mine"]).run_name == "mine"
    for run_id, more, message in (("none", [], "--rdzv-id"), ("x", ["--workers", "2"], "--workers 2")):
        under_torchrun(monkeypatch, run_id, ranks=3)
        with pytest.raises(SystemExit) as stop:
            gpo_ppo.parse_args([*words, *more])
        assert stop.value.code == 2 and message in capsys.readouterr().err


def test_a_name_that_has_a_checkpoint_goes_on_and_keeps_its_flags(base_run, tiny, monkeypatch, capsys):
    """The same command again, as after a restart, resumes; another seed under the same name is refused."""
    under_torchrun(monkeypatch, base_run.folder.name)
    words = without_workers(tiny(base_run.folder.parent, population=3, total_timesteps=2400))
    args = gpo_ppo.parse_args(words)
    assert Path(args.resume) == base_run.folder and args.workers == 1
    assert args.flags.items() <= json.loads((base_run.folder / "args.json").read_text()).items()
    with pytest.raises(SystemExit):
        gpo_ppo.parse_args([*words, "--seed", "2"])
    assert "--seed 2: the run was started with 1" in capsys.readouterr().err
