"""A second implementation of policies in NumPy and float64, from the file alone: noise, networks, sampler and choice."""

import json
import math

import numpy as np
from safetensors import safe_open

WORD, LONG = 0xFFFFFFFF, 0xFFFFFFFFFFFFFFFF


class Random:
    """ChaCha with 8 rounds (rand_chacha): one stream of a seed."""

    def __init__(self, seed, stream):
        self.key, self.stream, self.block, self.words = [], stream, 0, []
        for _ in range(8):  # rand_core's seed_from_u64: PCG32
            seed = (seed * 6364136223846793005 + 11634580027462260723) & LONG
            x, turn = (((seed >> 18) ^ seed) >> 27) & WORD, seed >> 59
            self.key.append(((x >> turn) | (x << (-turn & 31))) & WORD)

    def bits(self):
        if not self.words:
            halves = [n & WORD for x in (self.block, self.stream) for n in (x, x >> 32)]
            start = [0x61707865, 0x3320646E, 0x79622D32, 0x6B206574, *self.key, *halves]
            x = list(start)

            def add(a, b, d, turn):
                x[a] = (x[a] + x[b]) & WORD
                mixed = x[d] ^ x[a]
                x[d] = ((mixed << turn) | (mixed >> (32 - turn))) & WORD

            for i in range(8):
                for j in range(4):
                    a, b, c, d = j, 4 + (j + i % 2) % 4, 8 + (j + i % 2 * 2) % 4, 12 + (j + i % 2 * 3) % 4
                    add(a, b, d, 16), add(c, d, b, 12), add(a, b, d, 8), add(c, d, b, 7)
            self.words, self.block = [(n + m) & WORD for n, m in zip(x, start)], self.block + 1
        low, high = self.words[:2]
        self.words = self.words[2:]
        return low | high << 32

    def uniform(self):
        return (self.bits() >> 11) * 2.0**-53

    def between(self, low, high):
        return (self.bits() >> 12) * 2.0**-52 * (high - low) + low

    def normal(self):
        """The ziggurat of rand_distr."""
        while True:
            bits = self.bits()
            i, u = bits & 255, (bits >> 12) * 2.0**-51 - 1
            x = u * X[i]
            if abs(x) < X[i + 1]:
                return x
            if i == 0:
                return self.tail(u)
            if F[i + 1] + (F[i] - F[i + 1]) * self.uniform() < math.exp(-x * x / 2):
                return x

    def tail(self, u):
        def open01():
            return (self.bits() >> 12) * 2.0**-52 + 2.0**-53

        x, y = 1.0, 0.0
        while -2 * y < x * x:
            x, y = math.log(open01()) / R, math.log(open01())
        return x - R if u < 0 else R - x


R = 3.654152885361008796
AREA = 0.00492867323399
X = [AREA / math.exp(-R * R / 2), R]
while len(X) < 256:
    X.append(math.sqrt(-2 * math.log(math.exp(-X[-1] ** 2 / 2) + AREA / X[-1])))
X.append(0.0)
F = [math.exp(-x * x / 2) for x in X]

ACTIVATIONS = {
    "mish": lambda x: x * np.tanh(np.logaddexp(x, 0)),
    "relu": lambda x: np.maximum(x, 0),
    "silu": lambda x: x / (1 + np.exp(-x)),
    "tanh": np.tanh,
}


class Reference:
    def __init__(self, path):
        with safe_open(path, "np") as file:
            self.tensors = {name: file.get_tensor(name).astype(np.float64) for name in file.keys()}
            header = json.loads(file.metadata()["quad"])
        self.kind, self.shape, self.choice = (header["policy"].get(name) for name in ("kind", "shape", "choice"))
        none = {"offset": 0.0, "scale": 1.0}
        maps = {name: (header.get("scaling") or {}).get(name) or none for name in ("observations", "actions")}
        self.maps = {name: {key: np.asarray(x) for key, x in map.items()} for name, map in maps.items()}

    def mlp(self, prefix, config, x):
        layers = len(config["hidden"]) + 1
        for i in range(layers):
            kernel, bias = self.tensors[f"{prefix}{i}.kernel"], self.tensors[f"{prefix}{i}.bias"]
            x = x @ kernel + (bias if kernel.ndim == 2 else bias[:, None])
            if i + 1 < layers:
                if config["norm"]:
                    x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + (1e-5 if config.get("norm_epsilon") == "torch" else 1e-6))
                    scale, shift = self.tensors[f"{prefix}{i}.scale"], self.tensors[f"{prefix}{i}.shift"]
                    x = x * (scale if scale.ndim == 1 else scale[:, None]) + (shift if shift.ndim == 1 else shift[:, None])
                x = ACTIVATIONS[config["activation"]](x)
        return x

    def values(self, observations, actions, reduce=None):
        """Scales observations to the network's units."""
        q = self.mlp("critic.", self.shape["critic"], np.concatenate([observations, actions], -1))[..., 0]
        name, *kappa = (reduce or self.choice["aggregate"]).split(":")
        return q.min(0) if name == "min" else q.mean(0) - float(kappa[0]) * q.std(0) if kappa else q.mean(0)

    def to_network(self, name, x):
        scale = self.maps[name]["scale"]
        return (x - self.maps[name]["offset"]) / np.where(scale == 0, np.inf, scale)

    def to_user(self, actions):
        return self.maps["actions"]["offset"] + self.maps["actions"]["scale"] * actions

    def draw(self, observation, random, candidates):
        """Actions for one observation, [candidates, a]."""
        return (self.squash if self.kind == "squashed" else self.denoise)(observation, random, candidates)

    def squash(self, observation, random, candidates):
        a = self.shape["action_dim"]
        noise = np.asarray([random.normal() for _ in range(candidates * a)], np.float32).reshape(candidates, a)
        mean, log_std = np.split(self.mlp("actor.", self.shape["actor"], observation[None]).reshape(-1), 2)
        return np.tanh(mean + np.exp(np.clip(log_std, -5, 2)) * noise)

    def denoise(self, observation, random, candidates):
        a, steps, reverse = (self.shape[name] for name in ("action_dim", "diffusion_steps", "reverse"))
        noise = [[random.normal() for _ in range(candidates * a)] for _ in range(steps)]
        noise = np.asarray(noise, np.float32).astype(np.float64).reshape(steps, candidates, a)
        t = np.arange(1, steps + 1)
        beta = np.concatenate([[0.0], 1 - np.exp(-0.1 / steps - 0.5 * 9.9 * (2 * t - 1) / steps**2)])
        bar = np.cumprod(1 - beta)
        x, states = noise[0], np.tile(observation, (candidates, 1))
        for t in range(steps, 0, -1):
            angles = t * np.exp(-np.arange(8) * math.log(10_000) / 7)
            time = self.mlp("actor.time.", {"hidden": [1], "activation": "mish", "norm": False},
                            np.concatenate([np.cos(angles), np.sin(angles)]))
            trunk = np.concatenate([states, x, np.tile(time, (candidates, 1))], -1)
            epsilon = self.mlp("actor.trunk.", self.shape["actor"], trunk)
            clean = (x - math.sqrt(1 - bar[t]) * epsilon) / math.sqrt(bar[t])
            clean = clean if reverse == "clip-sample" else np.clip(clean, -1, 1)
            x = (math.sqrt(bar[t - 1]) * beta[t] * clean + math.sqrt(1 - beta[t]) * (1 - bar[t - 1]) * x) / (1 - bar[t])
            if t > 1:
                shrink = (1 - bar[t - 1]) / (1 - bar[t]) if reverse == "posterior" else 1.0
                x = x + math.sqrt(beta[t] * shrink) * noise[steps - t + 1]
            x = np.clip(x, -1, 1) if reverse == "clip-sample" else x
        return x

    def act(self, observation, random, **changes):
        """The action for one observation in the user's units, with the candidates and their values, if any."""
        s = self.to_network("observations", observation)
        if self.kind == "gaussian":
            # The file has the one network as an ensemble of one. Where it returns log σ, too, that comes last.
            out = self.mlp("actor.", self.shape["actor"], s[None]).reshape(-1)[: self.shape["action_dim"]]
            return self.to_user(np.tanh(out)), None, None
        choice = {**self.choice, **changes}
        drawn = self.draw(s, random, choice["candidates"])
        values = self.values(np.tile(s, (len(drawn), 1)), drawn, choice["aggregate"])
        scores, rule = values, choice["rule"]
        if rule == "nearest":
            scores = -((values - self.mlp("value.", self.shape["value"], s[None]).reshape(-1)) ** 2)
        chosen = int(np.argmax(scores))
        if isinstance(rule, dict) and len(drawn) > 1:
            weights = np.exp((scores - scores.max()) / rule["softmax"]["temperature"])
            chosen = int(np.argmax(np.cumsum(weights) > random.uniform() * weights.sum()))
        return self.to_user(drawn[chosen]), self.to_user(drawn), values
