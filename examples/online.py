"""A simulated cart learns to stop at a mark, from recorded pushes and then online: python examples/online.py FOLDER"""

import sys

import numpy as np
import quad_rl


class Cart:
    """Sees its position and speed, and is pushed by -1 to 1. Online a person pushes it back near the ends of the track."""

    def reset(self, seed=None, options=None):
        self.is_online = bool(options and options.get("online"))
        self.state, self.steps = np.array([np.random.default_rng(seed).uniform(-1.5, 1.5), 0.0]), 0
        return self.state, {}

    def step(self, action):
        (position, speed), push, info = self.state, float(np.clip(action[0], -1, 1)), {}
        if self.is_online and abs(position) > 1.6:
            push = -float(np.sign(position))
            info["intervention"] = [push]
        self.state, self.steps = np.array([position + 0.1 * speed, speed + 0.1 * push]), self.steps + 1
        info["success"], failed = bool(np.abs(self.state).max() < 0.1), abs(self.state[0]) > 2
        reward = -abs(self.state[0]) - 100.0 * failed
        return self.state, reward, info["success"] or failed, self.steps == 100, info


def record(episodes):
    cart, rows, rng = Cart(), [], np.random.default_rng(0)
    for seed in range(episodes):
        (seen, _), ended = cart.reset(seed, {"online": True}), False
        while not ended:
            push = rng.uniform(-1, 1, 1) if cart.steps % 10 == 0 else push
            after, reward, terminated, truncated, info = cart.step(push)
            rows.append((seen, info.get("intervention", push), reward, terminated, truncated))
            seen, ended = after, terminated or truncated
    names = ("observations", "actions", "rewards", "terminations", "truncations")
    return quad_rl.Dataset.from_arrays(**{name: np.array(column) for name, column in zip(names, zip(*rows))})


with quad_rl.Evaluators("cart", lambda seed: Cart(), score="success", workers=2):
    lengths = {"steps": 2_000, "online_steps": 5_000, "eval_interval": 1_000}
    run = quad_rl.train(record(100), env="cart", algorithm="td3-bc", run_dir=sys.argv[1], **lengths)
print([(score["step"], score["environment_steps"], score["score"]) for score in run.scores])
