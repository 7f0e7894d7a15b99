// Asks the learner what there is, and shows it. Nothing that it says is taken for HTML: all of it becomes text.

import { chart, element, keep, number } from "./charts.js";

const EVERY = 2000;
const RATE_OVER = 15000;
const $ = (id) => document.getElementById(id);
const shown = new Set(asked());
const samples = [];
let list = "";

// The runs that the address names as a JSON list; any other end of an address names none.
function asked() {
  try {
    const names = JSON.parse(decodeURIComponent(location.hash.slice(1)));
    return Array.isArray(names) ? names : [];
  } catch {
    return [];
  }
}

// The answer, or nothing where there is none.
async function ask(path) {
  const response = await fetch(path, { cache: "no-store" });
  if (!response.ok && response.status !== 404) throw new Error(`${path} answers ${response.status}`);
  return response.ok ? response.json() : null;
}

function row(...cells) {
  const made = element("tr");
  for (const cell of cells) made.append(cell instanceof Node ? cell : element("td", cell ?? "–"));
  return made;
}

function right(text) {
  return element("td", text, { class: "right" });
}

function facts(pairs, attributes = {}) {
  const made = element("dl", "", attributes);
  for (const [name, value] of pairs) {
    const fact = element("div");
    fact.append(element("dt", name), element("dd", value));
    made.append(fact);
  }
  return made;
}

function showRuns(runs) {
  const only = runs.length === 1 && !runs[0].error;
  $("list").hidden = only;
  if (only) {
    shown.clear();
    shown.add(runs[0].name);
  } else if (!list && shown.size === 0) {
    runs.filter((run) => run.at_work).forEach((run) => shown.add(run.name));
  }
  const newest = JSON.stringify(runs);
  if (newest === list) return;
  list = newest;
  const focused = document.activeElement?.dataset?.run;
  $("runs").replaceChildren(...runs.map((run) => {
    if (run.error) return row("", run.name, element("td", run.error, { class: "bad", colspan: 4 }));
    const tick = element("input", "", { type: "checkbox", "data-run": run.name, "aria-label": `show ${run.name}` });
    tick.checked = shown.has(run.name);
    tick.addEventListener("change", () => {
      shown[tick.checked ? "add" : "delete"](run.name);
      location.hash = encodeURIComponent(JSON.stringify([...shown]));
      refresh();
    });
    const [box, name] = [element("td"), element("td")];
    box.append(tick);
    const local = run.page?.startsWith("http://") && ["localhost", "127.0.0.1"].includes(location.hostname);
    name.append(local ? element("a", run.name, { href: run.page }) : run.name);
    const score = run.score === null ? "–" : `${run.score.toFixed(1)} @${run.score_step}`;
    return row(box, name, run.task, run.method, run.state + (run.at_work ? ", at work" : ""), right(score));
  }));
  [...$("runs").querySelectorAll("input")].find((tick) => tick.dataset.run === focused)?.focus();
}

function showCharts(runs) {
  const kept = new Set();
  const named = (run, label) => (runs.length === 1 ? label : [run.run, label].filter(Boolean).join(" "));
  const scores = runs.map((run) => ({ label: named(run, "") || "mean", points: run.evaluations.filter((one) => one[4]) }));
  if (scores.some(({ points }) => points.length)) {
    const data = runs.length === 1 ? `; the data's own episodes have ${number(runs[0].dataset_score)}` : "";
    const about = `Mean over an evaluation's episodes, ± their standard deviation${data}.`;
    const measure = runs.every((run) => run.measure === "return") ? "Return" : "Score";
    kept.add(chart($("score"), "score", measure, about, scores));
  }
  const rates = runs.map((run) => ({ label: named(run, "") || "steps/s", points: rate(run.history.rows) }));
  if (rates.some(({ points }) => points.length)) {
    kept.add(chart($("metrics"), "rate", "Gradient steps per second", "", rates));
  }
  // Metrics whose names differ in a number at their end share a chart.
  const groups = new Map();
  for (const run of runs) {
    for (const { name, help } of run.metrics) {
      const column = run.history.names.indexOf(name);
      const points = run.history.rows.map((values) => [values[0], values[2 + column]]).filter(([, value]) => Number.isFinite(value));
      if (!points.length) continue;
      const [, stem, end] = /^(.*?)(?:_(\d+))?$/.exec(name);
      if (!groups.has(stem)) groups.set(stem, { helps: new Set(), lines: [] });
      groups.get(stem).helps.add(help);
      groups.get(stem).lines.push({ label: named(run, end ?? "") || stem, points });
    }
  }
  for (const [stem, { helps, lines }] of groups) kept.add(chart($("metrics"), stem, stem, [...helps].join(" "), lines));
  keep(kept);
}

function rate(rows) {
  const between = (before, after) => [after[0], (after[0] - before[0]) / (after[1] - before[1])];
  return rows.slice(1).map((after, index) => between(rows[index], after)).filter(([, value]) => Number.isFinite(value) && value > 0);
}

function showDetails(runs) {
  const parts = runs.flatMap((run) => {
    const settings = element("details");
    settings.append(element("summary", "Configuration"), element("pre", run.settings));
    const table = element("table");
    table.append(element("thead"), element("tbody"));
    const columns = ["step", "seed", "score", "return", "length", "evaluator"];
    table.tHead.append(row(...columns.map((name) => element("th", name, { scope: "col" }))));
    for (const one of run.episodes.toReversed()) table.tBodies[0].append(row(...columns.map((name) => one[name] === undefined ? "" : name === "evaluator" ? one[name] : number(one[name]))));
    const wide = element("div", "", { class: "wide" });
    wide.append(element("h3", "Last episodes"), table);
    const about = [["task", run.task], ["algorithm", run.agent], ["seed", String(run.seed)], ["data", run.dataset]];
    return [element("h2", `Run ${run.run}`), facts(about, { class: "facts" }), settings, wide];
  });
  const open = [...$("details").querySelectorAll("details")].map((one) => one.open);
  $("details").replaceChildren(...parts);
  [...$("details").querySelectorAll("details")].forEach((one, index) => { one.open = open[index] ?? false; });
}

function duration(seconds) {
  if (seconds < 90) return `${Math.round(seconds)} s`;
  if (seconds < 5400) return `${Math.round(seconds / 60)} min`;
  return seconds < 172800 ? `${(seconds / 3600).toFixed(1)} h` : `${(seconds / 86400).toFixed(1)} days`;
}

function showLive(live) {
  $("now").hidden = $("pool").hidden = !live;
  if (!live) return;
  const now = performance.now();
  samples.push([now, live.step]);
  while (samples.length > 2 && now - samples[0][0] > RATE_OVER) samples.shift();
  const speed = (1000 * (live.step - samples[0][1])) / (now - samples[0][0]);
  const left = live.step >= live.steps ? "trained" : speed > 0 ? `${duration((live.steps - live.step) / speed)} left` : "…";
  [$("progress").value, $("progress").max] = [live.step, live.steps];
  $("figures").replaceChildren(...facts([
    ["gradient steps", `${live.step} of ${live.steps}`], ["steps per second", number(speed)], ["training", left],
    ["episodes to score", String(live.episodes_pending)], ["evaluators", String(live.evaluators.length)],
  ]).children);
  $("health").textContent = live.problems.join("\n") || "all is well";
  $("health").className = live.problems.length ? "bad" : "good";
  $("evaluators").replaceChildren(...live.evaluators.map(({ name, job, seconds_ago: ago, fits }) => {
    const idle = fits ? "waits for a job" : "has not asked for a job of this environment";
    return row(name, job ? `step ${job.step}: ${job.done} of ${job.episodes} episodes` : idle, right(ago === null ? "–" : `${Math.round(ago)} s ago`));
  }));
}

async function refresh() {
  try {
    const [runs, live] = await Promise.all([ask("api/runs"), ask("api/live")]);
    showRuns(runs);
    const answers = await Promise.all([...shown].map((name) => ask(`api/run/${encodeURIComponent(name)}`)));
    const found = answers.filter((run) => run && !run.error);
    if (!live) $("health").textContent = answers.map((run) => run?.error ?? "").filter(Boolean).join("\n");
    $("title").textContent = document.title = runs.length === 1 ? (live?.run ?? runs[0].name) : `${runs.length} runs`;
    showLive(live);
    showCharts(found);
    showDetails(found);
  } catch (error) {
    $("health").textContent = `There is no new answer (${error.message}). What is shown may be old.`;
    $("health").className = "bad";
  }
}

async function follow() {
  if (!document.hidden) await refresh();
  setTimeout(follow, EVERY);
}
document.addEventListener("visibilitychange", () => document.hidden || refresh());
follow();
