"""Are a run's critics right? Compares them with true values, which the simulator gives (docs/lambda.md).

python examples/probe.py gradients|choices RUN STEP [--states 64] [--rollouts 16] [--length 400] [--seed 0] [--json]

RUN is of QUAD, with any guidance. An action's true value is the mean discounted return, in the critics' units, of rollouts
that begin with it and then take one sample of the policy in each state. Needs h5py.
"""

import argparse
import json
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import quad_rl
from quad_rl.onnx.file import File

BATCH = 256  # Rollouts at a time: each has a simulation.
CHAINS = 64  # Reverse processes of a state, of which the first noisy action within ±(1 − H) is taken.
H = 0.1  # Change of an action to either side, of which slopes are central differences.
CANDIDATES, SIMILAR, RESAMPLES = 32, 32, 10_000
WEIGHTS = ["λ = 0", "λ = 1", "best constant", "mean λ of each t", "shuffled λ", "QUAD's λ", "1, at the denoised estimate"]
DIRECTIONS = ["each critic's gradient", "the critics' mean gradient", "at the denoised estimate"]
AGGREGATES = {"mean": "mean", "min": "minimum", "mean-minus-std:1": "mean − 1·std"}


class Network:
    """An ensemble of Mish layers: x [rows, in] -> outputs [K, rows, out], and the first output's gradients [K, rows, in]."""

    def __init__(self, file, prefix):
        names = [f"{prefix}{i}." for i in range(9) if f"{prefix}{i}.kernel" in file]
        self.layers = [(file[name + "kernel"], file[name + "bias"][..., None, :]) for name in names]

    def __call__(self, x):
        slopes = []
        for i, (kernel, bias) in enumerate(self.layers):
            x = x @ kernel + bias
            if i + 1 < len(self.layers):
                e = np.exp(np.minimum(x, 20))
                n = e * (e + 2)
                slopes.append(n / (n + 2) + x * 4 * e * (e + 1) / (n + 2) ** 2)
                x = x * n / (n + 2)
        gradient = np.swapaxes(self.layers[-1][0], -1, -2)[..., :1, :]
        for (kernel, _), slope in zip(self.layers[-2::-1], slopes[::-1]):
            gradient = (gradient * slope) @ np.swapaxes(kernel, -1, -2)
        return x, gradient


class Run:
    """A snapshot's networks, and true values of its policy."""

    def __init__(self, folder, step, length):
        self.about, self.length = quad_rl.runs(folder)[0], length
        self.policy = quad_rl.Policy.load(Path(folder, f"snapshots/step_{step:09}.safetensors"))
        file = File(self.policy.to_bytes())
        plain = not file.units and not file.chunk and file.shape.get("reverse", "clip-clean") == "clip-clean"
        if file.kind != "diffusion" or not plain:
            raise SystemExit(f"{folder} is no run of QUAD without --normalize, chunks and history")
        self.o, self.a, self.steps = (file.shape[name] for name in ("observation_dim", "action_dim", "diffusion_steps"))
        self.trunk, self.critics = Network(file, "actor.trunk."), Network(file, "critic.")
        angles = np.arange(1, self.steps + 1)[:, None] * np.exp(-np.arange(8) * np.log(10_000) / 7)
        self.times = Network(file, "actor.time.")(np.concatenate([np.cos(angles), np.sin(angles)], 1))[0]
        maze = self.simulation().state[2] is not None
        low, high = (0, 1) if maze else (self.about["dataset.min_return"], self.about["dataset.max_return"])
        rules = {"locomotion": (0, 1000 / (high - low)), "as-is": (0, 1), "subtract-1": (1, 1)}
        self.subtract, self.scale = rules[self.about["experiment.reward"]]

    def simulation(self):
        return quad_rl.Simulation(self.policy.environment, self.about["experiment.seed"])

    def noise(self, observations, actions, t):
        """The predicted ε_θ(a^t, s, t)."""
        return self.trunk(np.concatenate([observations, actions, np.repeat(self.times[t - 1 : t], len(actions), 0)], 1))[0]

    def visit(self, seeds, rng):
        """States (state, observation) that the policy acts in: of the episode of each seed one, drawn uniformly."""
        episodes, simulations, kept = self.policy.begin(seeds), [self.simulation() for _ in seeds], [None for _ in seeds]
        for simulation, seed in zip(simulations, seeds):
            simulation.reset(seed)
        live, steps = list(range(len(seeds))), 0
        while live:
            steps += 1
            for i in live:
                if rng.random() * steps < 1:
                    kept[i] = simulations[i].state, simulations[i].observation
            actions = episodes.act([simulations[i].observation for i in live], rows=live)
            live = [i for i, action in zip(live, actions) if not any(simulations[i].step(action)[1:])]
        return kept

    def returns(self, rollouts):
        """The discounted return of each (state, first action, seed of the policy's noise)."""
        batches = [rollouts[i : i + BATCH] for i in range(0, len(rollouts), BATCH)]
        return np.concatenate([self.roll_out(*zip(*batch)) for batch in batches])

    def roll_out(self, states, actions, seeds):
        episodes, simulations = self.policy.begin(seeds, candidates=1, guidance=0), [self.simulation() for _ in seeds]
        for simulation, state in zip(simulations, states):
            simulation.state = state
        returns, live, discount = np.zeros(len(seeds)), list(range(len(seeds))), 1.0
        for step in range(self.length):
            own = episodes.act([simulations[i].observation for i in live], rows=live) if live else []
            ended = set()
            for i, action in zip(live, own if step else actions):
                reward, terminated, _ = simulations[i].step(np.float32(action))
                returns[i] += discount * np.float32((np.float32(reward) - self.subtract) * self.scale)
                ended |= {i} if terminated else set()
            live = [i for i in live if i not in ended]
            discount *= self.about["experiment.agent.gamma"]
        return returns


def noisy_actions(run, observations, seed):
    """Actions a^t within ±(1 − H), one of each state and t, and what critics say there; the share of others for t = 1..T; and the
    mean |Q| of the policy's own actions, by which training divides gradients."""
    noise = run.policy.noise(len(observations), candidates=CHAINS, guidance=0, seed=seed)["noise"]  # [n, T, CHAINS, a]
    noise = np.moveaxis(noise, 1, 0).reshape(run.steps, -1, run.a)
    alpha = np.exp(-0.1 / run.steps - 0.5 * 9.9 * (2 * np.arange(1, run.steps + 1) - 1) / run.steps**2)
    bar = np.cumprod(np.concatenate([[1.0], alpha]))
    rows, drawn, outside = np.repeat(observations, CHAINS, 0), [], []
    x = noise[0]
    for t in range(run.steps, 0, -1):
        fits = (np.abs(x) <= 1 - H).all(1).reshape(-1, CHAINS)
        outside.insert(0, 1 - fits.mean())
        states = np.flatnonzero(fits.any(1))
        epsilon = run.noise(rows, x, t)
        clean = np.clip((x - epsilon * np.sqrt(1 - bar[t])) / np.sqrt(bar[t]), -1, 1)
        kept = states * CHAINS + fits[states].argmax(1)
        gradients, denoised = (run.critics(np.concatenate([rows[kept], a[kept]], 1))[1][..., run.o :] for a in (x, clean))
        u = epsilon[kept] / (np.linalg.norm(epsilon[kept], axis=1, keepdims=True) + 1e-8)
        drawn.append((states, np.full(len(states), t), x[kept], u, gradients.swapaxes(0, 1), denoised.mean(0)))
        ahead, beta = bar[t - 1], 1 - alpha[t - 1]
        x = (clean * np.sqrt(ahead) * beta + x * np.sqrt(1 - beta) * (1 - ahead)) / (1 - bar[t])
        x = x + np.sqrt(beta) * noise[run.steps - t + 1] if t > 1 else x
    scale = np.abs(run.critics(np.concatenate([rows, x], 1))[0]).mean()
    names = ("state", "t", "action", "u", "gradients", "denoised")
    return {name: np.concatenate(column) for name, column in zip(names, zip(*drawn))}, outside, scale


def slopes(noisy, gradients):
    """Slopes along u, the critics' and the true ones: `gradients` [n, rollouts, a] are of simulated rollouts."""
    claimed = np.einsum("nka,na->nk", noisy["gradients"], noisy["u"])
    true = np.einsum("nra,na->nr", gradients, noisy["u"])
    mean = noisy["gradients"].mean(1, keepdims=True)
    along = []
    for direction in (noisy["gradients"], mean, noisy["denoised"][:, None]):
        size = np.linalg.norm(direction, axis=2)
        along.append([size.mean(1), (np.einsum("nka,na->nk", direction, gradients.mean(1)) / size).mean(1)])
    return {
        "state": noisy["state"],
        "t": noisy["t"],
        "estimate": claimed.mean(1),  # l̄ and σ² of Eq. 22
        "variance": claimed.var(1),
        "denoised": (noisy["denoised"] * noisy["u"]).sum(1),
        "truth": true.mean(1),
        "noise": true.var(1) / (true.shape[1] - 1),  # of that mean
        "along": np.moveaxis(np.array(along), -1, 0),
    }


def risks(s):
    """A row for each of WEIGHTS w: its mean, its risk E[(w·l)²] − 2·E[w·l·truth] + E[truth²], and the risk above QUAD's, as they
    are and with both multiplied by their best factors. The rollouts' noise is subtracted."""
    square, truth = (s.estimate**2).mean(), (s.truth**2 - s.noise).mean()
    best = max((s.estimate * s.truth).mean() / square, 0)
    is_t = s.t[:, None] == np.unique(s.t)
    mean, mean_square = (is_t @ (is_t.T @ x / is_t.sum(0)) for x in (s.lam, s.lam**2))
    one = np.ones_like(s.lam)
    w = np.stack([0 * one, one, best * one, mean, mean, s.lam, one])
    slope = np.stack([s.estimate] * 6 + [s.denoised])
    own = (w * slope) ** 2
    own[4] = mean_square * s.estimate**2  # Over all ways to draw another λ of the same t.
    own, product = own.mean(1), (w * slope * s.truth).mean(1)
    risk = (own - 2 * product + truth) / square
    scaled = (truth - np.maximum(product, 0) ** 2 / np.where(own > 0, own, 1)) / square
    return np.stack([w.mean(1), risk, risk - risk[5], scaled - scaled[5]], 1)


def directions(s):
    claimed, true = s.along.mean(0).T
    return np.stack([claimed, true, true / claimed], 1)


def agreement(s):
    """Of the samples of each t, and of all."""
    rows = []
    for kept in [*(s.t == t for t in np.unique(s.t)), s.t > 0]:
        estimate, variance, truth, noise = (x[kept] for x in (s.estimate, s.variance, s.truth, s.noise))
        error, square = (estimate - truth) ** 2, (truth**2).mean()
        within = np.sqrt(error) <= 1.96 * np.sqrt(variance + noise)
        ranks = rank_correlation(estimate, truth), rank_correlation(variance, error - noise)
        rows.append([s.lam[kept].mean(), *ranks, within.mean(), 1 - noise.mean() / square])
    return np.array(rows)


def rank_correlation(x, y):
    """Spearman's, in which equal numbers share the mean of their ranks."""
    x, y = ([np.searchsorted(np.sort(v), v, side) for side in ("left", "right")] for v in (x, y))
    x, y = (np.sum(ranks, 0) - np.mean(np.sum(ranks, 0)) for ranks in (x, y))
    return x @ y / np.sqrt(max((x @ x) * (y @ y), 1e-12))


def choose(values, halves, distances, count):
    """Splits each state's candidates into groups of `count` and takes the largest of `values` [states, CANDIDATES] in each. Means
    over groups: its true value above the group's mean; its true value below that of the group's best, which one half of the
    rollouts finds and the other values; and its distance."""
    groups = CANDIDATES // count
    values, one, other, distances = (x[:, : groups * count].reshape(-1, groups, count) for x in (values, *halves, distances))

    def pick(x, index):
        return np.take_along_axis(x, index[..., None], -1)[..., 0]

    chosen, truth = values.argmax(-1), (one + other) / 2
    regrets = [pick(y, x.argmax(-1)) - pick(y, chosen) for x, y in ((one, other), (other, one))]
    numbers = pick(truth, chosen) - truth.mean(-1), np.mean(regrets, 0), pick(distances, chosen)
    return np.stack([x.mean(1) for x in numbers], 1)


def distances(files, observations, actions):
    """From actions [n, candidates, a] to the nearest action of the SIMILAR recorded states that are most like the observation."""
    recorded, taken = (np.concatenate([h5py.File(file)[name][:] for file in files]) for name in ("observations", "actions"))
    scale = recorded.std(0)
    recorded, observations = (x[:, scale > 0] / scale[scale > 0] for x in (recorded, observations))
    similar = [np.argpartition(((recorded - x) ** 2).sum(1), SIMILAR - 1)[:SIMILAR] for x in observations]
    return np.stack([np.linalg.norm(a[:, None] - taken[rows], axis=2).min(1) for a, rows in zip(actions, similar)])


def table(title, columns, names, states, statistics):
    """The rows of `statistics` of states, given as indices, with 95 % bootstrap intervals over the states."""
    rng = np.random.default_rng(0)
    drawn = [statistics(rng.choice(states, len(states))) for _ in range(RESAMPLES)]
    numbers = np.stack([statistics(states), *np.percentile(drawn, [2.5, 97.5], axis=0)], -1)
    rows = [(name, [dict(zip(("value", "low", "high"), x)) for x in row]) for name, row in zip(names, numbers.tolist())]
    return {"title": title, "columns": columns, "rows": rows}


def gradient_tables(run, states, rollouts, seed):
    noisy, outside, scale = noisy_actions(run, np.array([observation for _, observation in states]), seed)
    changes = H * np.stack([np.eye(run.a), -np.eye(run.a)], 1).reshape(-1, run.a)  # + and − of each axis
    pairs = zip(noisy["state"], noisy["action"])
    changed = [(states[i][0], a + change, seed) for i, a in pairs for seed in rollouts[i] for change in changes]
    pairs = run.returns(changed).reshape(len(noisy["t"]), -1, run.a, 2)
    samples = slopes(noisy, (pairs[..., 0] - pairs[..., 1]) / (2 * H))
    tau, delta = run.about["experiment.agent.tau"], run.about["experiment.agent.delta"] * scale**2
    nu = samples["estimate"].var()  # Eq. 23
    samples["lam"] = nu / (nu + samples["variance"] / tau + delta)  # Eq. 24
    rows = {i: np.flatnonzero(samples["state"] == i) for i in np.unique(samples["state"])}

    def make(title, columns, names, statistics):
        def resampled(states):
            kept = np.concatenate([rows[i] for i in states])
            return statistics(SimpleNamespace(**{name: column[kept] for name, column in samples.items()}))

        return table(title, columns, names, list(rows), resampled)

    counts = [f"t = {t}: {(samples['t'] == t).sum()} actions, {100 * share:.0f} % left out" for t, share in enumerate(outside, 1)]
    risk = ["mean weight", "risk", "above QUAD's λ", "each at its best scale"]
    ranks = ["mean λ", "l̄ with truth", "σ² with squared error", "within 1.96 σ", "not noise"]
    return [
        make("Risk of weights (Eq. 14), over the mean square of l̄", risk, WEIGHTS, risks),
        make("Slopes along gradients", ["claimed", "true", "true / claimed"], DIRECTIONS, directions),
        make("Noisy actions", ranks, [*counts, "all"], agreement),
    ]


def choice_tables(run, states, rollouts, seed):
    observations = np.array([observation for _, observation in states])
    drawn = {name: run.policy.sample(observations, candidates=CANDIDATES, aggregate=name, guidance=0, seed=seed)
             for name in AGGREGATES}
    actions = drawn["mean"][0]
    taken = [(states[i][0], a, seed) for i in range(len(states)) for a in actions[i] for seed in rollouts[i]]
    returns = run.returns(taken).reshape(len(states), CANDIDATES, -1)
    halves = [half.mean(2) for half in np.array_split(returns, 2, axis=2)]
    away = distances([file["path"] for file in run.about["dataset.files"]], observations, actions)
    return tables_of_choices({name: values for name, (_, values) in drawn.items()}, halves, away)


def tables_of_choices(values, halves, away):
    ranks = {"the other half of the rollouts": [rank_correlation(*x) for x in zip(*halves)]}
    choices = {"one candidate": choose(values["mean"], halves, away, 1)}
    for name, text in AGGREGATES.items():
        ranks[f"the critics' {text}"] = [rank_correlation(*x) for x in zip(values[name], sum(halves))]
        choices |= {f"largest {text} of {count}": choose(values[name], halves, away, count) for count in (2, 5, 10, CANDIDATES)}

    def make(title, columns, rows):
        numbers = np.array(list(rows.values())).reshape(len(rows), -1, len(columns))
        return table(title, columns, rows, np.arange(numbers.shape[1]), lambda drawn: numbers[:, drawn].mean(1))

    return [
        make("Values of 32 candidates", ["rank correlation with the truth"], ranks),
        make("Choices among candidates", ["above the mean candidate", "regret", "distance from the data"], choices),
    ]


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("tables", choices=["gradients", "choices"])
    parser.add_argument("run")
    parser.add_argument("step", type=int)
    for name, default in {"states": 64, "rollouts": 16, "length": 400, "seed": 0}.items():
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    run, rng = Run(args.run, args.step, args.length), np.random.default_rng(args.seed)
    seeds = rng.integers(2**63, size=(args.states, 1 + args.rollouts))
    states = run.visit(seeds[:, 0], rng)
    tables = {"gradients": gradient_tables, "choices": choice_tables}[args.tables](run, states, seeds[:, 1:], args.seed)
    if args.json:
        return print(json.dumps(tables))
    for made in tables:
        print(made["title"], made["columns"])
        for name, numbers in made["rows"]:
            print(f"{name:45}", *("{value:9.3f} [{low:.3f}, {high:.3f}]".format(**number) for number in numbers))


if __name__ == "__main__":
    main()
