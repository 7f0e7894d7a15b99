"""Runs the benchmarks of learner, evaluator and kernels and of their peers in turns, and prints what
docs/performance.md shows. To be started by deploy/bench.sh.

    bench.py ROUNDS [algorithms [NAME ...]]

With `algorithms` only their gradient steps beside JAX's, or those of some (`jax_step.py --names`). A round visits each
configuration for some seconds, in which JAX, the learner and the machine's peaks are measured one after the other: machines
may be shared, and change their speed. Figures are medians over the rounds; a ratio is the median of the rounds' ratios.
"""

import json
import os
import platform
import statistics
import subprocess
import sys
from pathlib import Path

# Shapes, as in algorithms/benches/update.rs and evaluator/benches/rollout.rs.
OBSERVATION, ACTION, TIME, STEPS, BATCH = 11, 3, 32, 5, 256
CONFIGURATIONS = {
    "paper, 10 samples": {"hidden": 256, "critics": 10, "samples": 10, "predictions": 1},
    "paper, 1 sample": {"hidden": 256, "critics": 10, "samples": 1, "predictions": 1},
    "demo": {"hidden": 128, "critics": 5, "samples": 1, "predictions": 0},
}
EPISODES = CANDIDATES = 10
ROLLOUT_STEPS = 4
PEAK_CALLS, PEAK_ROWS, PEAK_WIDTH = 1000, 128, 256
# In kernels/benches/kernels.rs: which to run, ours, and what a library does in its place.
KERNELS, OURS = "/20 in turn$|/mish", ("ours", "mish")
LIBRARIES = {"gemm": "gemm", "mish by std's exp": "std's exp"}
PYTHON, JAX_STEP = ".deps/venv/bin/python", "algorithms/benches/jax_step.py"
# Asked for fewer instructions than the CPU has, JAX's compiler keeps to them, too. Its library of products takes what it finds.
ONLY_AVX2 = os.environ.get("QUAD_INSTRUCTIONS") == "avx2"
PEER_ENVIRONMENT = {"XLA_FLAGS": "--xla_cpu_max_isa=AVX2"} if ONLY_AVX2 else {}


class Work:
    """Arithmetic: floating-point operations of products, and activations without and with their slope."""

    def __init__(self, flop=0.0, mish=0.0, slope=0.0):
        self.flop, self.mish, self.slope = flop, mish, slope

    def __add__(self, other):
        return Work(self.flop + other.flop, self.mish + other.mish, self.slope + other.slope)

    def bound(self, peak):
        """Seconds at the machine's peaks."""
        return self.flop / peak["flop"] + self.mish / peak["mish"] + self.slope / peak["slope"]


def forward(rows, inputs, hidden, outputs):
    return Work(rows * 2 * (inputs * hidden + 2 * hidden**2 + hidden * outputs), rows * 3 * hidden)


def back(rows, hidden, outputs):
    """From the output's gradient to those before each activation, whose slopes the way forward had to find."""
    return Work(rows * 2 * (2 * hidden**2 + hidden * outputs), -rows * 3 * hidden, rows * 3 * hidden)


def parts(hidden, critics, samples, predictions):
    """The parts of a gradient step: {benchmark: its arithmetic}; nothing counts as shared between rows."""
    actor = lambda rows: forward(rows, OBSERVATION + ACTION + TIME, hidden, ACTION)
    critic = lambda rows: forward(rows, OBSERVATION + ACTION, hidden, 1)
    rows = critics * BATCH
    return {
        "sampled next actions": actor(STEPS * BATCH * samples),
        "target critics": critic(rows * samples),
        "critic step": critic(rows) + back(rows, hidden, 1) + Work(critic(rows).flop),
        "critic optimizer": Work(),
        "critic EMA": Work(),
        "Q-gradients' scale": critic(rows),
        "Q-gradients": critic(rows) + back(rows, hidden, 1) + Work(rows * 2 * hidden * ACTION),
        "actor step": actor(BATCH * (1 + predictions)) + back(BATCH, hidden, ACTION) + Work(actor(BATCH).flop),
        "actor optimizer and EMA": Work(),
    }


def results(bench, names):
    """Runs those of a bench whose names match; yields what criterion calls each, and its median in seconds."""
    command = ["cargo", "bench", "--locked", "--workspace", "--quiet", "--bench", bench, "--", "--noplot", "--quiet"]
    quick = ["--warm-up-time", "0.3", "--measurement-time", "1", "--sample-size", "10", "--nresamples", "1000"]
    written = lambda: {path: path.stat().st_mtime_ns for path in Path("target/criterion").rglob("new/estimates.json")}
    before = written()
    subprocess.run([*command, *quick, names], check=True, capture_output=True)
    for estimates, time in written().items():
        # An unchanged file is from an earlier run: another benchmark, or one that was renamed.
        if before.get(estimates) != time:
            median = json.loads(estimates.read_text())["median"]["point_estimate"] / 1e9
            yield json.loads(estimates.with_name("benchmark.json").read_text()), median


def criterion(bench, names):
    """{name: median seconds}"""
    return {benchmark["full_id"]: seconds for benchmark, seconds in results(bench, names)}


def kernels():
    """{kernel: {whose: G/s}}: floating-point operations of products, elements of activations."""
    rates = {}
    for benchmark, seconds in results("kernels", KERNELS):
        rate = benchmark["throughput"]["Elements"] / seconds / 1e9
        rates.setdefault(benchmark["group_id"], {})[benchmark["function_id"]] = rate
    return rates


class Peer:
    """A script in JAX that stays, and measures a moment whenever it is asked."""

    def __init__(self, *command):
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        command = [PYTHON, "-W", "ignore", *command, "--serve", "--seconds", "1"]
        self.process = subprocess.Popen(command, env=os.environ | PEER_ENVIRONMENT, **pipes)

    def measure(self, line=""):
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()
        if not (answer := self.process.stdout.readline()):
            raise SystemExit(f"bench: {self.process.args[3]} has ended, see above")
        return json.loads(answer)


def moment(jax, *benches):
    """JAX's times just now, and those of benches, of which the first measures the machine's peaks."""
    seconds = {}
    for bench, names in benches:
        seconds |= criterion(bench, names)
    threads = len(os.sched_getaffinity(0))
    elements = threads * PEAK_CALLS * PEAK_ROWS * PEAK_WIDTH
    peak = {
        "flop": elements * 2 * PEAK_WIDTH / seconds["peak/product"],
        "mish": elements / seconds["peak/mish"],
        "slope": elements / seconds["peak/mish and slope"],
    }
    return {"jax": jax, "seconds": seconds, "peak": peak, "threads": threads}


def measure_algorithms(count, some):
    """{algorithm, or its phase: its rounds}"""
    peer = Peer(JAX_STEP, "--tuned")
    names = subprocess.run([PYTHON, "-W", "ignore", JAX_STEP, "--names"], check=True, capture_output=True, text=True).stdout
    rounds = {name: [] for name in some or names.splitlines() if name not in CONFIGURATIONS}
    for _ in range(count):
        for name, moments in rounds.items():
            moments.append({"jax": min(peer.measure(name).values()), "ours": criterion("update", f"^update(, bf16)?/{name}$")})
    return rounds


def measure(count):
    """{configuration: its rounds}, those of the evaluation as `rollout` and of the kernels as `kernels`."""
    plain, tuned = Peer(JAX_STEP), Peer(JAX_STEP, "--tuned")
    rollout = Peer("evaluator/benches/jax_rollout.py")
    rounds = {name: [] for name in [*CONFIGURATIONS, "rollout", "kernels"]}
    for i in range(count):
        print(f"bench: round {i + 1} of {count}", file=sys.stderr)
        for name in CONFIGURATIONS:
            jax = {"plain": plain.measure(name), "tuned": tuned.measure(name)}
            rounds[name].append(moment(jax, ("update", f"^(peak/|update(, bf16)?/{name}$|{name}/)")))
        rounds["rollout"].append(moment(rollout.measure(), ("update", "^peak/"), ("rollout", "")))
        rounds["kernels"].append(kernels())
    return rounds


def median(rounds, of):
    return statistics.median(of(x) for x in rounds)


def table(*rows):
    head, *rest = rows
    for row in head, ["---", *["---:"] * (len(head) - 1)], *rest:
        print("| " + " | ".join(row) + " |")
    print()


def machine(rounds, count):
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    model = next((line.split(": ")[1] for line in lines if line.startswith("model name")), platform.machine())
    flags = next((line.split() for line in lines if line.startswith("flags")), [])
    can = ", ".join(flag for flag in ("avx512f", "avx512_bf16", "amx_bf16") if flag in flags) or "no AVX-512"
    can = f"has {can}, restricted to AVX2" if ONLY_AVX2 else can
    product, mish, slope = (median(rounds, lambda x: x["peak"][name]) / 1e9 for name in ("flop", "mish", "slope"))
    print(f"{model} ({can}), {rounds[0]['threads']} threads; the `gemm` crate does {product:.0f} GFLOP/s, a Mish loop")
    print(f"{mish:.1f} G elements/s, with the slope {slope:.1f}. Medians of {count} rounds.\n")


def has_bf16(rounds):
    """True if this machine is faster in bf16; else it was not timed."""
    return any(", bf16" in name for name in rounds[0]["seconds"])


def updates(all_rounds):
    head = "gradient step | bound | f32 | of the bound | JAX, plain | ratio | JAX, tuned | ratio | bf16 | over best JAX"
    rows = [head.split(" | ")]
    ms = lambda of: f"{1e3 * median(rounds, of):.1f} ms"
    ours = lambda x: x["seconds"][f"update/{name}"]
    bf16 = lambda x: x["seconds"][f"update, bf16/{name}"]
    for name, shapes in CONFIGURATIONS.items():
        work, rounds = sum(parts(**shapes).values(), Work()), all_rounds[name]
        plain, tuned = (lambda x, kind=kind: min(x["jax"][kind].values()) for kind in ("plain", "tuned"))
        best = lambda x: min(plain(x), tuned(x))
        ratio = lambda over, under: f"{median(rounds, lambda x: over(x) / under(x)):.2f} ×"
        rounding = [ms(bf16), ratio(best, bf16)] if has_bf16(rounds) else ["", ""]
        share = median(rounds, lambda x: work.bound(x["peak"]) / ours(x))
        rows.append(
            [name, ms(lambda x: work.bound(x["peak"])), ms(ours), f"{100 * share:.0f} %", ms(plain), ratio(plain, ours)]
            + [ms(tuned), ratio(tuned, ours), *rounding]
        )
    table(*rows)


def algorithms(all_rounds):
    rows = [["gradient step", "JAX, tuned", "f32", "over JAX", "bf16", "over JAX"]]
    for name, rounds in all_rounds.items():
        row = [name, f"{1e3 * median(rounds, lambda x: x['jax']):.2f} ms"]
        for group in ("update", "update, bf16"):
            if f"{group}/{name}" in rounds[0]["ours"]:
                ours = lambda x, group=group: x["ours"][f"{group}/{name}"]
                ratio = median(rounds, lambda x: x["jax"] / ours(x))
                row += [f"{1e3 * median(rounds, ours):.2f} ms", f"{ratio:.2f} ×"]
        rows.append([*row, *[""] * (len(rows[0]) - len(row))])
    table(*rows)


def step_parts(all_rounds):
    for name, shapes in CONFIGURATIONS.items():
        rows = [[name, "GFLOP", "M Mish", "bound", "takes", "of the bound"]]
        total, spent, rounds = Work(), 0.0, all_rounds[name]
        for part, work in parts(**shapes).items():
            seconds = median(rounds, lambda x: x["seconds"][f"{name}/{part}"])
            total, spent = total + work, spent + seconds
            bound = median(rounds, lambda x: work.bound(x["peak"]))
            figures = [f"{work.flop / 1e9:.2f}", f"{(work.mish + work.slope) / 1e6:.1f}", f"{1e3 * bound:.2f} ms"]
            figures = figures if work.flop else ["", "", ""]
            rows.append(
                [part, *figures, f"{1e3 * seconds:.2f} ms", f"{100 * bound / seconds:.0f} %" if work.flop else ""]
            )
        whole = median(rounds, lambda x: x["seconds"][f"update/{name}"])
        bound = median(rounds, lambda x: total.bound(x["peak"]))
        rest = f"{1e3 * (whole - spent):.2f} ms"
        rows.append(["noise, targets, weights λ, candle's bookkeeping, waiting", "", "", "", rest, ""])
        figures = [f"{total.flop / 1e9:.2f}", f"{(total.mish + total.slope) / 1e6:.1f}", f"{1e3 * bound:.2f} ms"]
        rows.append(["the step", *figures, f"{1e3 * whole:.2f} ms", f"{100 * bound / whole:.0f} %"])
        table(*rows)


def rollouts(rounds):
    decisions = EPISODES * CANDIDATES
    work = forward(STEPS * decisions, OBSERVATION + ACTION + TIME, 256, ACTION)
    work += forward(10 * decisions, OBSERVATION + ACTION, 256, 1)
    physics = lambda x: EPISODES * x["seconds"]["environment/hopper"] / x["threads"]
    jax = lambda x: x["jax"]["seconds"]
    head = "ten Hopper episodes | environment steps/s | over JAX | step of all ten | its policy"
    rows = [head.split(" | ") + ["network and physics at their best", "over that"]]
    rows.append(["JAX, one at a time", f"{median(rounds, lambda x: 1 / jax(x)):.0f}", "", "", "", "", ""])
    for name in ("f32", "bf16") if has_bf16(rounds) else ("f32",):
        step = lambda x: x["seconds"][f"rollout/{ROLLOUT_STEPS} steps, {name}"] / ROLLOUT_STEPS
        bound = lambda x: work.bound(x["peak"]) + physics(x)
        row = [f"evaluator, {name}", f"{median(rounds, lambda x: EPISODES / step(x)):.0f}"]
        row += [f"{median(rounds, lambda x: jax(x) * EPISODES / step(x)):.1f} ×"]
        row += [f"{1e3 * median(rounds, of):.2f} ms" for of in (step, lambda x: x["seconds"][f"select/{name}"])]
        # The peak was measured in f32.
        row += [f"{1e3 * median(rounds, bound):.2f} ms", f"{median(rounds, lambda x: step(x) / bound(x)):.2f} ×"]
        rows.append(row if name == "f32" else [*row[:-2], "", ""])
    table(*rows)


def kernel_rates(rounds):
    rows = [["kernel, one thread", "ours", "library", "its rate", "ours over it"]]
    for kernel, rates in rounds[0].items():
        mine = next((whose for whose in OURS if whose in rates), None)
        for library in [whose for whose in LIBRARIES if mine and whose in rates]:
            ours, theirs = (lambda x, whose=whose: x[kernel][whose] for whose in (mine, library))
            unit = "GFLOP/s" if mine == "ours" else "G elements/s"
            mine_rate, its_rate = (f"{median(rounds, of):.3g} {unit}" for of in (ours, theirs))
            ratio = f"{median(rounds, lambda x: ours(x) / theirs(x)):.2f} ×"
            rows.append([kernel, mine_rate, LIBRARIES[library], its_rate, ratio])
    table(*rows)


def main():
    count, only_algorithms = int(sys.argv[1]), sys.argv[2:3] == ["algorithms"]
    algorithms(measure_algorithms(count, sys.argv[3:]))
    if only_algorithms:
        return
    rounds = measure(count)
    Path("target/bench.json").write_text(json.dumps(rounds, indent=1))
    machine([moment for name, moments in rounds.items() for moment in moments if name != "kernels"], count)
    updates(rounds)
    step_parts(rounds)
    rollouts(rounds["rollout"])
    kernel_rates(rounds["kernels"])


if __name__ == "__main__":
    main()
