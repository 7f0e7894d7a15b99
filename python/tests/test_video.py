"""Videos of LeRobot's folders as numbers. Each frame has a gray of its own, by which it is known again."""

import json
import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot_folder import episodes, write

from quad_rl import Dataset

TOP, RULE = "observation.images.top", {"observations": ["observation.state"], "reward": "step-cost", "success": "all"}
PATHS = {"v3.0": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
         "v2.1": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"}
GRAYS = np.split(np.arange(10, 190, 4), [5, 11, 18, 26, 35])  # Of the steps of six episodes.


def gray(frames):
    assert frames.dtype == np.uint8 and frames.shape[1:] == (48, 64, 3)
    return frames.mean((1, 2, 3))[:, None]


def film(path, grays):
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=30, width=64, height=48, pix_fmt="yuv420p", options={"g": "4"})
        for level in grays:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((48, 64, 3), level, np.uint8), format="rgb24")))
        file.mux(stream.encode())


def recorded(root, version="v3.0"):
    """A folder of six episodes with a video each in v2.1; in v3.0 there are two, for two and four of them."""
    write(root, episodes(), version)
    info = json.loads((root / "meta/info.json").read_text())
    (root / "meta/info.json").write_text(json.dumps({**info, "video_path": PATHS[version], "chunks_size": 4}))
    begins, file_index = np.array([0, 5, 0, 7, 15, 24]) / 30, [0, 0, 1, 1, 1, 1]
    for i, grays in enumerate(GRAYS if version == "v2.1" else [np.concatenate(GRAYS[:2]), np.concatenate(GRAYS[2:])]):
        at = {"episode_chunk": i // 4, "episode_index": i, "chunk_index": 3, "file_index": i}
        film(root / PATHS[version].format(video_key=TOP, **at), grays)
    if version == "v3.0":
        path = root / "meta/episodes/chunk-000/file-000.parquet"
        meta = pq.read_table(path)
        for key, numbers in {"chunk_index": [3] * 6, "file_index": file_index, "from_timestamp": begins}.items():
            meta = meta.append_column(f"videos/{TOP}/{key}", pa.array(numbers))
        pq.write_table(meta, path)
    return root


@pytest.mark.parametrize("version", PATHS)
def test_each_frame_is_seen_in_its_row(tmp_path, version):
    dataset = Dataset.from_lerobot(recorded(tmp_path / "data", version), **RULE, features={TOP: gray})
    actual = dataset._rows
    assert dataset.observation_names[-2:] == ["observation.state.roll", f"{TOP}.gray[0]"]
    assert np.abs(actual.observations[:, 3] - np.concatenate(GRAYS)).max() < 1.9
    after = ~actual.terminals
    assert np.array_equal(actual.next_observations[after], np.roll(actual.observations, -1, 0)[after]) and after.sum() == 39
    assert not any("streams of images" in note for note in dataset.notes)


def test_what_cannot_be_seen_is_refused(tmp_path):
    root = recorded(tmp_path / "data")
    film(root / f"videos/{TOP}/chunk-003/file-001.mp4", range(20))
    for message, asked in {
        "top is video, but only rows of numbers are learned from\nhint: features=": {"observations": [TOP]},
        "observation.state is no video\nhint: there are observation.images.top": {"features": {"observation.state": gray}},
        r"top.<lambda> has shape \[48\] for 5 frames, but must have \[5, k\]": {"features": {TOP: lambda frames: frames[0, :, 0, 0]}},
        "file-001.mp4: there is no frame at 0.667 s": {"features": {TOP: gray}},
    }.items():
        with pytest.raises(ValueError, match=message):
            Dataset.from_lerobot(root, **{**RULE, **asked})
    (root / "meta/episodes/chunk-000/file-000.parquet").unlink()
    with pytest.raises(ValueError, match="meta/episodes does not say where observation.images.top of episode 0 is"):
        Dataset.from_lerobot(root, **RULE, features={TOP: gray})


def test_the_example_learns_and_acts(tmp_path):
    example = (Path(__file__).parents[2] / "examples/camera.py").read_text()
    (tmp_path / "camera.py").write_text(example.replace("steps=2_000", "steps=2, set={'batch_size': 16}"))
    command = [sys.executable, "camera.py", recorded(tmp_path / "data"), "run"]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert ended.returncode == 0 and ended.stdout.startswith(f"{TOP}.colors[47]\n["), ended.stderr
