// Charts of lines over gradient steps, with error bands. Charts are updated in place, so that they stay zoomed.

// Okabe and Ito's colors, which most color-blind readers can tell apart, and a gray for both color schemes.
const COLORS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#888888"];
const charts = new Map();
const dark = matchMedia("(prefers-color-scheme: dark)");

export function element(tag, text = "", attributes = {}) {
  const node = document.createElement(tag);
  node.textContent = text;
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  return node;
}

export function number(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  return size !== 0 && (size < 1e-3 || size >= 1e6) ? value.toExponential(2) : String(Number(value.toPrecision(4)));
}

function short(step) {
  if (step >= 1e6) return `${number(step / 1e6)} M`;
  return step >= 1e4 ? `${number(step / 1e3)} k` : number(step);
}

// Scripts may set a line's color as a style; the page's policy forbids styles in HTML.
function legend({ series, x }) {
  const lines = document.createDocumentFragment();
  for (const { label, color, y } of series.filter((one) => one.isVisible)) {
    const line = element("span");
    const mark = element("i");
    mark.style.background = color;
    line.append(mark, label);
    if (x !== undefined && y !== undefined) line.append(` ${number(y)}`);
    lines.append(line);
  }
  if (x !== undefined) lines.append(element("span", `step ${x}`));
  return lines;
}

function colors() {
  const [axis, grid] = dark.matches ? ["#a3adb8", "#2c333b"] : ["#57606a", "#e4e7eb"];
  return { axisLineColor: axis, gridLineColor: grid };
}
dark.addEventListener("change", () => charts.forEach(({ graph }) => graph.updateOptions(colors())));

// Rows for Dygraph: x, and [value, error] of each line.
function rows(lines) {
  const byStep = new Map();
  lines.forEach(({ points }, index) => {
    for (const [step, value, error] of points) {
      if (!byStep.has(step)) byStep.set(step, Array.from(lines, () => [null, null]));
      byStep.get(step)[index] = [value, error ?? 0];
    }
  });
  return [...byStep].sort(([one], [other]) => one - other).map(([step, values]) => [step, ...values]);
}

// Makes or updates the chart `key` of lines { label, points: [[step, value, error]] }.
export function chart(parent, key, title, about, lines) {
  const file = rows(lines);
  const labels = ["step", ...lines.map(({ label }) => label)];
  const last = lines.map(({ label, points }) => `${label} ${number(points.at(-1)?.[1])}`).join(", ");
  if (!charts.has(key)) {
    const figure = element("figure");
    const [caption, heading, note] = [element("figcaption"), element("span"), element("p", "", { class: "muted" })];
    caption.append(heading, note);
    const [place, names] = [element("div", "", { class: "chart", role: "img" }), element("div", "", { class: "legend" })];
    figure.append(caption, place, names);
    parent.append(figure);
    const graph = new Dygraph(place, file, {
      labels, errorBars: true, sigma: 1, fillAlpha: 0.15, connectSeparatedPoints: true, strokeWidth: 2, colors: COLORS,
      legend: "always", labelsDiv: names, legendFormatter: legend, includeZero: key === "score",
      drawPoints: file.length < 60, pointSize: 3, ...colors(),
      axes: { x: { drawGrid: false, axisLabelFormatter: short }, y: { axisLabelWidth: 56, axisLabelFormatter: number } },
    });
    charts.set(key, { graph, figure, place, heading, note, shown: "" });
  }
  const entry = charts.get(key);
  // The user may have ticked other runs.
  [entry.heading.textContent, entry.note.textContent] = [title, about];
  const shown = JSON.stringify([labels, file]);
  if (shown !== entry.shown) {
    entry.shown = shown;
    entry.graph.updateOptions({ file, labels, drawPoints: file.length < 60 });
    entry.place.setAttribute("aria-label", `${title}, newest values: ${last}`);
  }
  return key;
}

export function removeAllBut(keys) {
  for (const [key, { graph, figure }] of charts) {
    if (keys.has(key)) continue;
    graph.destroy();
    figure.remove();
    charts.delete(key);
  }
}
