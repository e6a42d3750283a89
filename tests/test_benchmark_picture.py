"""benchmark/picture.py on a tiny run; needs requirements-benchmark.txt."""

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

pytest.importorskip("matplotlib", reason="pictures need requirements-benchmark.txt")
pytest.importorskip("sklearn", reason="pictures need requirements-benchmark.txt")

from benchmark import picture  # noqa: E402


@pytest.fixture(scope="module")
def drawn(train, tmp_path_factory):
    """A finished run with all its pictures."""
    run = train(tmp_path_factory.mktemp("picture"), population=3, total_timesteps=2400)
    words = [str(run.folder), "--csv", str(run.folder / "curves.csv"), "--episodes", "4"]
    assert picture.main(words) == list(picture.NAMES)
    return run


def test_all_pictures_of_a_run_lie_in_its_folder_and_in_its_events(drawn):
    for name in picture.NAMES:
        assert 1000 < (drawn.folder / f"{name}.png").stat().st_size < picture.PNG_BYTES
        assert (drawn.folder / f"{name}.svg").read_text().startswith("<?xml")
    assert len((drawn.folder / "curves.csv").read_text().splitlines()) > 2
    events = EventAccumulator(str(drawn.folder)).Reload()
    assert set(events.Tags()["images"]) == {f"pictures/{name}" for name in picture.NAMES}
    assert "charts/episodic_return" in events.Tags()["scalars"]


def test_drawing_again_gives_the_same_files_and_replaces_the_images(drawn, tmp_path):
    before = {name: (drawn.folder / f"{name}.png").read_bytes() for name in ("curves", "family_tree", "crossovers")}
    picture.main([str(drawn.folder), "--pictures", *before])
    assert before == {name: (drawn.folder / f"{name}.png").read_bytes() for name in before}
    assert len(list(drawn.folder.glob("events*.pictures"))) == 1
    events = EventAccumulator(str(drawn.folder)).Reload()
    assert set(events.Tags()["images"]) == {f"pictures/{name}" for name in before}


def test_a_run_that_lasts_is_drawn_but_its_events_are_left_alone(drawn, tmp_path):
    lasting = tmp_path / "lasting"
    lasting.mkdir()
    for file in drawn.folder.iterdir():
        if file.is_file() and file.name != "evaluation.json" and not file.name.endswith(".pictures"):
            (lasting / file.name).write_bytes(file.read_bytes())
    picture.main([str(lasting), "--pictures", "curves", "family_tree"])
    assert not list(lasting.glob("events*.pictures"))


def test_several_runs_give_their_curves_together(drawn, train, tmp_path):
    other = train(tmp_path, population=3, total_timesteps=2400, seed=5)
    assert picture.main([str(drawn.folder), str(other.folder), "--output", str(tmp_path / "both")]) == ["curves"]
    assert sorted(file.name for file in (tmp_path / "both").iterdir()) == ["curves.png", "curves.svg"]


@pytest.mark.parametrize("size", [2, 8, 32])
def test_every_policy_has_a_place_of_its_own_in_the_family_tree(size):
    children = [
        {"id": size * (k + 1) + slot, "parents": [size * k + slot // 2, size * k + (slot + 1) % size], "round": k + 1}
        for k in range(4)
        for slot in range(size)
    ]
    lineage = picture.SimpleNamespace(rounds=[children[size * k : size * (k + 1)] for k in range(4)], winner=size * 4)
    x, generations = picture.place(lineage, set().union(*picture.ancestry(lineage)))
    assert len(generations) == 5
    for k, generation in enumerate(generations):
        assert sorted(generation) == list(range(size * k, size * (k + 1)))
        assert sorted(x[policy] for policy in generation) == list(range(size))
