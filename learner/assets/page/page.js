// Polls the learner's API and shows the answers as text, never as HTML.

import { chart, element, number, removeAllBut } from "./charts.js";

const POLL_INTERVAL_MS = 2000;
const SPEED_WINDOW_MS = 15000;
const $ = (id) => document.getElementById(id);
const selected = new Set(fromHash());
const samples = []; // [time, step]
let lastRuns = "";

// Names of runs in the address's fragment, a JSON list.
function fromHash() {
  try {
    const names = JSON.parse(decodeURIComponent(location.hash.slice(1)));
    return Array.isArray(names) ? names : [];
  } catch {
    return [];
  }
}

// null for 404.
async function fetchJson(path) {
  const response = await fetch(path, { cache: "no-store" });
  if (!response.ok && response.status !== 404) throw new Error(`${path} answers ${response.status}`);
  return response.ok ? response.json() : null;
}

function row(...cells) {
  const row = element("tr");
  for (const cell of cells) row.append(cell instanceof Node ? cell : element("td", cell ?? "–"));
  return row;
}

function right(text) {
  return element("td", text, { class: "right" });
}

function facts(pairs, attributes = {}) {
  const list = element("dl", "", attributes);
  for (const [name, value] of pairs) {
    const fact = element("div");
    fact.append(element("dt", name), element("dd", value));
    list.append(fact);
  }
  return list;
}

function showRuns(runs) {
  const isSingle = runs.length === 1 && !runs[0].error;
  $("list").hidden = isSingle;
  if (isSingle) {
    selected.clear();
    selected.add(runs[0].name);
  } else if (!lastRuns && selected.size === 0) {
    runs.filter((run) => run.at_work).forEach((run) => selected.add(run.name));
  }
  const newest = JSON.stringify(runs);
  if (newest === lastRuns) return;
  lastRuns = newest;
  const focused = document.activeElement?.dataset?.run;
  $("runs").replaceChildren(...runs.map((run) => {
    if (run.error) return row("", run.name, element("td", run.error, { class: "bad", colspan: 4 }));
    const tick = element("input", "", { type: "checkbox", "data-run": run.name, "aria-label": `show ${run.name}` });
    tick.checked = selected.has(run.name);
    tick.addEventListener("change", () => {
      selected[tick.checked ? "add" : "delete"](run.name);
      location.hash = encodeURIComponent(JSON.stringify([...selected]));
      refresh();
    });
    const [box, name] = [element("td"), element("td")];
    box.append(tick);
    const isLocal = run.page?.startsWith("http://") && ["localhost", "127.0.0.1"].includes(location.hostname);
    name.append(isLocal ? element("a", run.name, { href: run.page }) : run.name);
    const score = run.score === null ? "–" : `${run.score.toFixed(1)} @${run.score_step}`;
    return row(box, name, run.task, run.method, run.state + (run.at_work ? ", at work" : ""), right(score));
  }));
  [...$("runs").querySelectorAll("input")].find((tick) => tick.dataset.run === focused)?.focus();
}

function showCharts(runs) {
  const kept = new Set();
  const labeled = (run, label) => (runs.length === 1 ? label : [run.run, label].filter(Boolean).join(" "));
  const scores = runs.map((run) => ({ label: labeled(run, "") || "mean", points: run.evaluations.filter((one) => one[4]) }));
  if (scores.some(({ points }) => points.length)) {
    const ofData = runs.length === 1 ? runs[0].dataset_score : null;
    const data = ofData === null ? "" : `; the data's own episodes have ${number(ofData)}`;
    const begins = runs.length === 1 && runs[0].online_begins !== null ? ` Online learning begins after step ${runs[0].online_begins}.` : "";
    const about = `Mean over an evaluation's episodes, ± their standard deviation${data}.${begins}`;
    const measure = runs.every((run) => run.measure === "return") ? "Return" : "Score";
    kept.add(chart($("score"), "score", measure, about, scores));
  }
  const speeds = runs.map((run) => ({ label: labeled(run, "") || "steps/s", points: rates(run.history.rows) }));
  if (speeds.some(({ points }) => points.length)) {
    kept.add(chart($("metrics"), "rate", "Gradient steps per second", "", speeds));
  }
  // Metrics whose names differ only in a final number share a chart.
  const groups = new Map();
  for (const run of runs) {
    for (const { name, help } of run.metrics) {
      const column = run.history.names.indexOf(name);
      if (column < 0) continue;
      const points = run.history.rows.map((values) => [values[0], values[2 + column]]).filter(([, value]) => Number.isFinite(value));
      if (!points.length) continue;
      const [, stem, end] = /^(.*?)(?:_(\d+))?$/.exec(name);
      if (!groups.has(stem)) groups.set(stem, { helps: new Set(), lines: [] });
      groups.get(stem).helps.add(help);
      groups.get(stem).lines.push({ label: labeled(run, end ?? "") || stem, points });
    }
  }
  for (const [stem, { helps, lines }] of groups) kept.add(chart($("metrics"), stem, stem, [...helps].join(" "), lines));
  removeAllBut(kept);
}

// [step, gradient steps per second] between rows.
function rates(rows) {
  const rate = (before, after) => [after[0], (after[0] - before[0]) / (after[1] - before[1])];
  return rows.slice(1).map((after, index) => rate(rows[index], after)).filter(([, value]) => Number.isFinite(value) && value > 0);
}

function showDetails(runs) {
  const parts = runs.flatMap((run) => {
    const settings = element("details");
    settings.append(element("summary", "Configuration"), element("pre", run.settings));
    const table = element("table");
    table.append(element("thead"), element("tbody"));
    const columns = ["step", "seed", "score", "return", "length", "evaluator"];
    table.tHead.append(row(...columns.map((name) => element("th", name, { scope: "col" }))));
    // Steps and seeds have every digit.
    const cell = (value) => (typeof value === "string" || Number.isInteger(value) ? String(value) : number(value));
    for (const one of run.episodes.toReversed()) table.tBodies[0].append(row(...columns.map((name) => cell(one[name]))));
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
  while (samples.length > 2 && now - samples[0][0] > SPEED_WINDOW_MS) samples.shift();
  const speed = (1000 * (live.step - samples[0][1])) / (now - samples[0][0]);
  const left = live.step >= live.steps ? "trained" : speed > 0 ? `${duration((live.steps - live.step) / speed)} left` : "…";
  [$("progress").value, $("progress").max] = [live.step, live.steps];
  $("figures").replaceChildren(...facts([
    ["gradient steps", `${live.step} of ${live.steps}`], ["steps per second", number(speed)], ["training", left],
    ["episodes to score", String(live.episodes_pending)], ["evaluators", String(live.evaluators.length)], ...online(live.online),
  ]).children);
  $("health").textContent = live.problems.join("\n") || "all is well";
  $("health").className = live.problems.length ? "bad" : "good";
  $("evaluators").replaceChildren(...live.evaluators.map(({ name, job, seconds_ago: ago, fits }) => {
    const idle = fits ? "waits for a job" : "has not asked for a job of this environment";
    return row(name, job ? `${job.online ? "online" : "evaluation"}, step ${job.step}: ${job.done} of ${job.episodes} episodes` : idle, right(ago === null ? "–" : `${Math.round(ago)} s ago`));
  }));
}

// Figures of an online run.
function online(now) {
  if (!now) return [];
  const newest = now.steps > 0 ? number(now.return) : "–";
  return [["experience", `${now.steps} of ${now.target}`], ["return online", newest], ["waited for experience", duration(now.wait_seconds)]];
}

async function refresh() {
  try {
    const [runs, live] = await Promise.all([fetchJson("api/runs"), fetchJson("api/live")]);
    showRuns(runs);
    const answers = await Promise.all([...selected].map((name) => fetchJson(`api/run/${encodeURIComponent(name)}`)));
    const found = answers.filter((run) => run && !run.error);
    if (!live) $("health").textContent = answers.map((run) => run?.error ?? "").filter(Boolean).join("\n");
    $("title").textContent = document.title = runs.length === 1 ? (live?.run ?? runs[0].name) : `${runs.length} runs`;
    showLive(live);
    showCharts(found);
    showDetails(found);
  } catch (error) {
    $("health").textContent = `The learner does not answer (${error.message}). What is shown may be old.`;
    $("health").className = "bad";
  }
}

async function poll() {
  if (!document.hidden) await refresh();
  setTimeout(poll, POLL_INTERVAL_MS);
}
document.addEventListener("visibilitychange", () => document.hidden || refresh());
poll();
