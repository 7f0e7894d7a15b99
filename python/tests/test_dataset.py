"""Datasets from arrays and episodes: writing, training, refusals."""

import json
import subprocess
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from conftest import ACTION, OBSERVATION, arrays, train

from quad_rl import Dataset, Policy


def written(dataset, path):
    dataset.save(path)
    with h5py.File(path) as file:
        assert file.attrs["layout"] == "transitions"
        return {name: array[()] for name, array in file.items()}


def test_the_file_has_the_given_arrays(tmp_path):
    given = arrays()
    after = given["observations"] + 1
    actual = written(Dataset.from_arrays(**given, next_observations=after), tmp_path / "new" / "data.hdf5")
    names = {"terminations": "terminals", "truncations": "timeouts"}
    for name, array in {**given, "next_observations": after}.items():
        assert np.array_equal(actual[names.get(name, name)], array.astype(np.float32)), name
    assert actual["terminals"].dtype == bool


def test_next_observations_default_to_the_following_row(tmp_path):
    """Steps 0 to 2 end by a terminal, 3 to 5 are cut off, 6 is cut off at once, 7 terminates as it is cut off, 8 to 9 do not end."""
    o, row = np.arange(10.0)[:, None] * 10, np.arange(10)
    actual = written(
        Dataset.from_arrays(
            observations=o, actions=row / 10, rewards=row, terminations=np.isin(row, [2, 7]),
            truncations=np.isin(row, [5, 6, 7]).astype(int),
        ),
        tmp_path / "data.hdf5",
    )
    assert actual["rewards"].tolist() == [0, 1, 2, 3, 4, 7, 8]
    assert actual["observations"][:, 0].tolist() == [0, 10, 20, 30, 40, 70, 80]
    assert actual["next_observations"][:, 0].tolist() == [10, 20, 20, 40, 50, 70, 90]
    assert actual["terminals"].tolist() == [0, 0, 1, 0, 0, 1, 0]
    assert actual["timeouts"].tolist() == [0, 0, 0, 0, 1, 1, 1]


def test_episodes_and_arrays_make_the_same_rows(tmp_path):
    whole = arrays(n=300)
    ends = np.flatnonzero(whole["terminations"] | whole["truncations"]) + 1
    whole["truncations"][-1] = True
    parts = [slice(a, b) for a, b in zip([0, *ends], [*ends, 300]) if a < b]
    episodes = [{name: array[part] for name, array in whole.items()} for part in parts]
    by_flag = [
        SimpleNamespace(**{n: e[n] for n in ("observations", "actions", "rewards")},
                        terminated=bool(e["terminations"][-1]), truncated=bool(e["truncations"][-1]))
        for e in episodes
    ]
    expected = written(Dataset.from_arrays(**whole), tmp_path / "0.hdf5")
    assert len(expected["rewards"]) == 300 - sum(not e["terminations"][-1] for e in episodes)
    for i, same in enumerate((episodes, by_flag)):
        actual = written(Dataset.from_episodes(same), tmp_path / f"{i}.hdf5")
        assert all(np.array_equal(actual[name], expected[name]) for name in expected)

    last = [np.concatenate([e["observations"], np.full((1, OBSERVATION), 9.0)]) for e in episodes]
    known = Dataset.from_episodes({**e, "observations": o} for e, o in zip(episodes, last))
    actual = written(known, tmp_path / "known.hdf5")
    assert len(known) == len(actual["rewards"]) == 300
    open_end = {**episodes[0], "observations": last[0], "terminations": False, "truncations": False}
    cut = written(Dataset.from_episodes([open_end, open_end]), tmp_path / "open.hdf5")
    assert np.flatnonzero(cut["timeouts"]).tolist() == [ends[0] - 1, 2 * ends[0] - 1] and not cut["terminals"].any()
    assert (actual["next_observations"][ends - 1] == 9).all() and (actual["terminals"] | actual["timeouts"])[ends - 1].all()


def test_prints_the_summary_of_the_learner(data):
    dataset = Dataset.from_arrays(**arrays())
    ours = dataset.inspect()
    theirs = subprocess.run(["learner", "datasets", "inspect", "--json", str(data)], check=True, capture_output=True).stdout
    expected = json.loads(theirs)
    expected["files"][0]["path"] = "in memory"
    assert ours == expected
    assert repr(dataset) == f"Dataset({ours['transitions']} transitions, observations of 11 numbers, actions of 3)"
    assert "no problems found" in str(dataset) and "transitions   " + str(len(dataset)) in str(dataset)


def test_the_learner_trains_on_the_user_s_units(tmp_path):
    given = arrays()
    given["actions"] = given["actions"] * 40 + 100
    dataset = Dataset.from_arrays(**given)
    assert "--normalize actions" in " ".join(dataset.inspect()["problems"])
    dataset.save(tmp_path / "data.hdf5")
    snapshot = train(tmp_path / "run", tmp_path / "data.hdf5", "--task", "own-data", "--env", "mine", "--steps", "3",
                     "--normalize", "actions,observations")
    actions = Policy.load(snapshot).act(given["observations"][:50])
    assert actions.min() > 59.9 and actions.max() < 140.1 and np.ptp(actions) > 20


def test_refuses_invalid_arrays(tmp_path):
    good = arrays(n=200)

    def changed(name, row, value):
        array = np.ma.array(good[name].astype(np.float64))
        array[row] = value
        return Dataset.from_arrays(**{**good, name: array})

    def shaped(name, shape):
        return Dataset.from_arrays(**{**good, name: np.zeros(shape)})

    episode = {**{name: good[name][:5] for name in good}, "terminations": True, "truncations": False}
    for message, call in {
        r"observations, row 7: number 2 is nan, .* \(1 such rows\)": lambda: changed("observations", (7, 2), np.nan),
        "actions, row 150": lambda: changed("actions", (150, 0), np.inf),
        "rewards, row 3: it is inf": lambda: changed("rewards", 3, 1e300),
        r"actions has shape \[199, 3\], but must have \[200, k\]": lambda: shaped("actions", (199, ACTION)),
        r"rewards has shape \[200, 2\], but must have \[N\]": lambda: shaped("rewards", (200, 2)),
        r"next_observations has shape \[200, 4\], but must have \[200, 11\]": lambda: shaped("next_observations", (200, 4)),
        "terminations has shape": lambda: shaped("terminations", (20,)),
        "there is no episode": lambda: Dataset.from_episodes([]),
        "episode 1: there are no rewards": lambda: Dataset.from_episodes([episode, {}]),
        "episode 0: it has no step": lambda: Dataset.from_episodes([{**episode, "rewards": []}]),
        "episode 1: actions, row 2": lambda: Dataset.from_episodes([episode, {**episode, "actions": [0, 0, np.nan, 0, 0]}]),
        r"episode 0: observations has shape \[4, 11\], but must have \[5, k\]": lambda: Dataset.from_episodes(
            [{**episode, "observations": good["observations"][:4]}]
        ),
        r"episode 0: observations has shape \[7, 11\], but must have \[5, k\]": lambda: Dataset.from_episodes(
            [{**episode, "observations": good["observations"][:7]}]
        ),
        "same size": lambda: Dataset.from_episodes([episode, {**episode, "actions": np.zeros(5)}]),
        "of which none makes a transition\nhint: ": lambda: Dataset.from_arrays(
            **{name: array[:0] for name, array in good.items()}).save(tmp_path / "none"),
        r"observations, row 7 is masked \(2 such rows\)\nhint: ": lambda: changed("observations", [[7], [9]], np.ma.masked),
        r"terminations, row 3: 0.5 is neither 0 nor 1 \(1 such rows\)": lambda: changed("terminations", 3, 0.5),
        "truncations, row 4: -1.0 is neither": lambda: changed("truncations", 4, -1),
        "episode 0: terminations, row 4: 0.5 is": lambda: Dataset.from_episodes([{**episode, "terminations": 0.5}]),
        "episode 0: rewards, row 1 is masked": lambda: Dataset.from_episodes(
            [{**episode, "rewards": np.ma.masked_equal([0, 9, 0, 0, 0], 9)}]),
        "actions are integers": lambda: Dataset.from_arrays(**{**good, "actions": np.ones((200, 2), int)}),
    }.items():
        with pytest.raises(ValueError, match=message):
            call()
    assert not list(tmp_path.iterdir())


def test_counts_a_row_with_several_bad_numbers_once():
    good = arrays(n=200)
    good["observations"][7, 2:5] = np.nan
    with pytest.raises(ValueError, match=r"row 7: number 2 is nan, .* \(1 such rows\)"):
        Dataset.from_arrays(**good)
