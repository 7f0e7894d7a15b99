"""Learns from a LeRobot dataset with a camera, seen by a small encoder: python examples/camera.py FOLDER RUN"""

import sys

import numpy as np

import quad_rl


def colors(frames):
    """The mean colors of a grid of 4 x 4: uint8 [n, h, w, 3] to [n, 48], within [0, 1]. A pretrained network fits here as well."""
    n, h, w, _ = frames.shape
    return frames.reshape(n, 4, h // 4, 4, w // 4, 3).mean(axis=(2, 4)).reshape(n, 48) / 255


if __name__ == "__main__":
    dataset = quad_rl.Dataset.from_lerobot(sys.argv[1], observations=["observation.state"], reward="success-at-end", success="all",
                                           features={"observation.images.top": colors})
    policy = quad_rl.train(dataset, algorithm="iql", steps=2_000, normalize="actions,observations", run_dir=sys.argv[2]).policy()
    print(policy.observation_names[-1])  # observation.images.top.colors[47]
    state, frame = np.zeros(policy.observation_size - 48), np.zeros((480, 640, 3), np.uint8)  # the robot's
    print(policy.act(np.concatenate([state, colors(frame[None])[0]])))
