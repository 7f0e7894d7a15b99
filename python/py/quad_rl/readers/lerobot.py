"""LeRobot's folders of Parquet files, v3.0 (many episodes a file) and v2.x (one).

What they hold: `src/lerobot/datasets` of huggingface/lerobot, 0.4 and 0.3.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_rl._extras import library
from quad_rl._rows import Source
from quad_rl.readers.arrow import to_array
from quad_rl.readers.episodes import Episode, Log, Rule, Success, dataset, rule_columns
from quad_rl.readers.video import Encoder, column, encoded

Columns = dict[str, NDArray[Any]]
_REWARD, _SUCCESS, _DONE = "next.reward", "next.success", "next.done"
_TERMINATED, _TRUNCATED = "next.terminated", "next.truncated"
_INDEX = ["episode_index", "frame_index"]
_UNFINISHED = "unreadable, as files are of recordings that were not finalized: "


def from_lerobot(
    folder: str | PathLike[str],
    *,
    observations: Sequence[str],
    action: str = "action",
    reward: Rule = None,
    success: Success = None,
    terminate: Rule = None,
    task: str | None = None,
    continuous: bool = False,
    features: Mapping[str, Encoder] | None = None,
) -> Source:
    """A LeRobot dataset, v3.0 or v2.x: the folder with `meta/info.json`. Needs pyarrow.

    observations: its features that are seen, in this order, such as ["observation.state"]; no images or videos. Their numbers
        keep their units, and their names in the file and in the policy. action: the feature that is done.
    features: videos that are seen after the observations, each with the function that makes numbers of its frames, such as
        {"observation.images.top": encoder}: uint8 [n, h, w, 3] to [n, k]. Columns have the function's name, such as
        "observation.images.top.encoder[0]". Needs av.
    reward, success: as in `from_frame`, columns being features, or numbers in `meta/episodes`, and names `episode_index`.
        By default `next.reward` and `next.success`, where these were recorded.
    terminate: as `terminal` in `from_frame`. By default `next.terminated`, or `next.done` without `next.truncated`, where these
        were recorded. `next.done` alone is also set at time limits.
    task: the only task to be read, in its words; "all" for all of them. Episodes whose frames have several are dropped, but for
        "all".
    continuous: as in `from_frame`.

    LeRobot stores no observation after the last step, which is dropped in episodes that do not terminate. Frames after an
    episode's end are no steps: the first of them is the observation that it ended with. `notes` of the result counts what was
    left out. Raises ValueError for what has to be said and is not, ImportError without pyarrow.
    """
    root = Path(folder)
    if not (root / "meta/info.json").is_file():
        raise ValueError(f"{root} is no LeRobot dataset: there is no meta/info.json")
    info = json.loads((root / "meta/info.json").read_bytes())
    version, streams = str(info.get("codebase_version")), info["features"]
    if not version.startswith(("v2.", "v3.")):
        raise ValueError(f"{root}: a LeRobot dataset of {version}, but v2.x and v3.x are read\nhint: LeRobot converts it")
    features = features or {}
    seen = [*observations, *(column(name, encoder) for name, encoder in features.items())] if features else observations
    notes = _check_images(root, {name: stream["dtype"] for name, stream in streams.items()}, {*observations, action}, features)
    words = rule_columns(observations, action, reward, success, terminate)
    plain = [name for name, stream in streams.items() if stream["dtype"] not in ("image", "video", "string", "language")]
    wanted = {_REWARD, _SUCCESS, _DONE, _TERMINATED, _TRUNCATED, "task_index", *_INDEX, *(plain if words is None else words)}
    columns, unreadable = _frames(root, [name for name in plain if name in wanted])
    parts = _with_task(root, _whole(root, columns, info, unreadable, notes), task, notes)
    if features:
        _encode(root, parts, info, features)
    ends = [name for name in (_DONE, _TERMINATED, _TRUNCATED) if name in columns]
    if ends == [_DONE, _TRUNCATED]:
        for part in parts.values():
            part[_TERMINATED] = (part[_DONE] > 0) & ~(part[_TRUNCATED] > 0)
    terminated = _TERMINATED if _TERMINATED in ends or ends == [_DONE, _TRUNCATED] else ""
    rewarded, won, done = (name if name in columns else "" for name in (_REWARD, _SUCCESS, _DONE))
    episodes = _cut(parts, ends, notes)
    if rewarded and won and reward in (None, _REWARD):
        _suspect_shift(episodes, notes)
    names = {name: flat_names(stream.get("names")) for name, stream in streams.items()}
    log = Log(episodes, notes, plain, names, rewarded, won, done, terminated, continuous=continuous)
    return dataset(log, seen, [action], reward, success, terminate)


def _check_images(root: Path, kinds: Mapping[str, str], rows: set[str], features: Mapping[str, Encoder]) -> list[str]:
    """Raises ValueError for images as rows and for features that are no videos. Notes what is left out."""
    for name in [name for name in kinds if name in rows and kinds[name] in ("image", "video")]:
        hint = "hint: features= takes a function that makes numbers of a video"
        raise ValueError(f"{root}: {name} is {kinds[name]}, but only rows of numbers are learned from\n{hint}")
    for name in [name for name in features if kinds.get(name) != "video"]:
        videos = ", ".join(name for name, kind in kinds.items() if kind == "video")
        raise ValueError(f"{root}: {name} is no video\nhint: there are {videos or 'none'}")
    unseen = [name for name, kind in kinds.items() if kind in ("image", "video") and name not in features]
    return [f"left out: {len(unseen)} streams of images ({', '.join(unseen)})"] if unseen else []


def _frames(root: Path, wanted: list[str]) -> tuple[Columns, list[str]]:
    """The columns of all files, and the files that cannot be read. Where episodes lie is not looked up: converters err."""
    parts: list[Columns] = []
    unreadable = []
    for path in sorted((root / "data").glob("**/*.parquet")):
        try:
            table = library("pyarrow.parquet", "lerobot").ParquetFile(path).read(wanted)
        except (library("pyarrow", "lerobot").ArrowInvalid, OSError):
            unreadable.append(str(path.relative_to(root)))
            continue
        parts.append({name: to_array(table[name], name, str(path)) for name in table.column_names})
    there = [name for name in wanted if parts and all(name in part for part in parts)]
    if not {*_INDEX} <= {*there}:
        why = f"; {_UNFINISHED}{', '.join(unreadable)}" if unreadable else ""
        raise ValueError(f"{root}: no Parquet file in data has {' and '.join(_INDEX)}{why}")
    return {name: np.concatenate([part[name] for part in parts]) for name in there}, unreadable


def _encode(root: Path, parts: Mapping[int, Columns], info: Mapping[str, Any], features: Mapping[str, Encoder]) -> None:
    """Adds the numbers of videos. In v3 a file may have many episodes; `meta/episodes` says where each begins."""
    rows = {row["episode_index"]: row for row in _meta(root, "episodes")}
    for name, encoder in features.items():
        begins, full = f"videos/{name}/from_timestamp", column(name, encoder)
        for number, part in parts.items():
            row = rows.get(number, {})
            if begins not in row and "chunk_index" in info["video_path"]:
                raise ValueError(f"{root}: meta/episodes does not say where {name} of episode {number} is")
            at = {key: row.get(f"videos/{name}/{key}", 0) for key in ("chunk_index", "file_index")}
            at |= {"episode_index": number, "episode_chunk": number // info.get("chunks_size", 1000)}
            path = root / info["video_path"].format(video_key=name, **at)
            times = row.get(begins, 0.0) + part["frame_index"].reshape(-1) / info["fps"]
            part[full] = encoded(full, encoder, path, times, 1 / info["fps"])


def _meta(root: Path, name: str) -> list[dict[str, Any]]:
    """Rows of meta/NAME: lines of JSON in v2, Parquet in v3."""
    lines = root / f"meta/{name}.jsonl"
    if lines.exists():
        return [json.loads(line) for line in lines.read_bytes().splitlines()]  # Texts may have other ends of lines.
    parquet, rows = library("pyarrow.parquet", "lerobot"), []
    for file in sorted((root / "meta").glob(f"{name}*/**/*.parquet")) + sorted((root / "meta").glob(f"{name}.parquet")):
        opened = parquet.ParquetFile(file)
        rows += opened.read([key for key in opened.schema_arrow.names if not key.startswith("stats/")]).to_pylist()
    return rows


def _whole(
    root: Path, columns: Columns, info: Mapping[str, Any], unreadable: list[str], notes: list[str]
) -> dict[int, Columns]:
    """The episodes that have each frame once, in its order, with what `meta/episodes` says of all their frames."""
    try:
        rows = {row["episode_index"]: row for row in _meta(root, "episodes")}
    except (library("pyarrow", "lerobot").ArrowInvalid, OSError):
        rows = {}
    episode, frame = (columns[name].reshape(-1) for name in _INDEX)
    order = np.lexsort((frame, episode))
    numbers, first = np.unique(episode[order], return_index=True)
    parts = zip(*(np.split(array[order], first[1:]) for array in columns.values()))
    there = {int(number): dict(zip(columns, part)) for number, part in zip(numbers, parts)}
    kept, longer, total = {}, [], max(int(info.get("total_episodes", 0)), len(there))
    unlisted = [str(number) for number in there if rows and number not in rows]
    there = {number: part for number, part in there.items() if str(number) not in unlisted}
    if unlisted:
        some = ", ".join(unlisted[:5]) + (", …" if len(unlisted) > 5 else "")
        notes.append(f"{len(unlisted)} of {total} episodes dropped: meta/episodes does not list them, as if they were taken out (episode {some})")
        total -= len(unlisted)
    splits = info.get("splits") or {}
    if len(splits) > 1:
        notes.append(f"meta/info.json has splits ({', '.join(f'{name} {part}' for name, part in splits.items())}); all are read")
    for number, part in there.items():
        frames, row = part["frame_index"].reshape(-1), rows.get(number, {})
        constants = {name: value for name, value in row.items()
                     if name not in part and "/" not in name and isinstance(value, (bool, int, float))}
        steps, said = len(frames), row.get("length", len(frames))
        if steps >= said and np.array_equal(frames, np.arange(steps)):
            kept[number] = part | {name: np.full(steps, value) for name, value in constants.items()}
            longer += [f"episode {number}: {said}, but data has {steps}"] if steps > said else []
    broken = [str(number) for number in there if number not in kept]
    if broken:
        some = ", ".join(broken[:5]) + (", …" if len(broken) > 5 else "")
        notes.append(f"{len(broken)} of {total} episodes dropped: frames are missing or there twice (episode {some})")
    if longer:
        some = "; ".join(longer[:5]) + ("; …" if len(longer) > 5 else "")
        notes.append(f"{len(longer)} of {total} episodes: meta/episodes is wrong about their frames, which are all read ({some})")
    if unreadable or len(there) < total:
        why = _UNFINISHED + ", ".join(unreadable) if unreadable else "their rows are in no file"
        notes.append(f"{total - len(there)} of {total} episodes dropped: {why}")
    return kept


def _with_task(root: Path, parts: dict[int, Columns], task: str | None, notes: list[str]) -> dict[int, Columns]:
    """The episodes of which all frames are of the task."""
    tasks = {number: tuple(np.unique(part["task_index"]).tolist()) if "task_index" in part else (0,) for number, part in parts.items()}
    counts = Counter(tasks[number] for number in sorted(tasks, key=lambda number: tasks[number]))
    several = [number for number, indices in tasks.items() if len(indices) > 1]
    if task == "all" or (task is None and len(counts) < 2 and not several):
        return parts
    # The other column of v3's is pandas's index, under any name.
    texts = {row["task_index"]: next(row[name] for name in row if name != "task_index") for row in _meta(root, "tasks")}
    chosen = [number for number, indices in tasks.items() if len(indices) == 1 and texts.get(indices[0]) == task]
    if not chosen:
        told = ", ".join(f"{' and '.join(repr(texts.get(index, index)) for index in indices)} "
                         f"({count} episodes{', each of several' if len(indices) > 1 else ''})" for indices, count in counts.items())
        hint = 'hint: task="…" reads the episodes of one of them; task="all" all, which only an observation can tell apart'
        raise ValueError(f"{root}: {f'no episode is of task {task!r} alone' if task else 'several tasks'}: {told}\n{hint}")
    if several:
        some = ", ".join(map(str, several[:5])) + (", …" if len(several) > 5 else "")
        notes.append(f"{len(several)} of {len(parts)} episodes dropped: their frames are of several tasks (episode {some})")
    rest = len(parts) - len(several) - len(chosen)
    notes.append(f"{rest} of {len(parts)} episodes dropped: of another task than {task!r}")
    return {number: parts[number] for number in chosen}


def flat_names(names: Any) -> list[str]:
    """LeRobot has a list, lists in a dictionary, the place of each name, or nothing. Names that several lists have, as those of two
    arms, get their keys: `left.j0`."""
    if isinstance(names, Mapping):
        if all(isinstance(place, int) for place in names.values()):
            return sorted(names, key=lambda name: int(names[name]))
        pairs = [(key, name) for key, part in names.items() for name in flat_names(part)]
        plain = [name for _, name in pairs]
        return plain if len({*plain}) == len(plain) else [f"{key}.{name}" for key, name in pairs]
    return [str(name) for name in names or ()]


def _cut(parts: dict[int, Columns], flags: list[str], notes: list[str]) -> list[Episode]:
    """Episodes up to their end, with the frame after it as what was observed last."""
    episodes, cut, beyond = [], 0, 0
    for number, part in parts.items():
        steps = len(part["frame_index"])
        ends = np.flatnonzero(sum(part[name].reshape(-1) > 0 for name in flags))
        after = int(ends[0]) + 1 if len(ends) else steps
        cut, beyond = cut + (after < steps), beyond + max(0, steps - after - 1)
        last = {name: array[after : after + 1] for name, array in part.items()} if after < steps else {}
        episodes.append(Episode(number, {name: array[:after] for name, array in part.items()}, last))
    if cut:
        notes.append(f"{cut} of {len(episodes)} episodes go on after {' or '.join(flags)}: the next frame is read as their last observation, "
                     f"{beyond} frames after it are dropped")
    return episodes


def _suspect_shift(episodes: list[Episode], notes: list[str]) -> None:
    """Warns of rewards that come a step before their success."""
    won = [e.columns for e in episodes if np.any(e.columns[_SUCCESS] > 0)]
    early = sum(int(np.argmax(c[_REWARD])) + 1 == int(np.argmax(c[_SUCCESS] > 0)) for c in won)
    if early and early == len(won):
        notes.append(f"next.reward is largest a step before next.success in {early} of {len(won)} successes: is it shifted?")
