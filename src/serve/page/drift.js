// The dialogue of drift: a control chart for each series of each reference surface, over the days.

import { $, ask, dated, doubtLines, fill, hide, make, many, plain, say } from "./dom.js";
import { go, opened, route } from "./route.js";

const dialog = $("drift");
const WIDTH = 640;
const HEIGHT = 150;
// Room at the left and right edge, and above and below the values.
const EDGE = 8;
const ROOM = 22;

const QUANTITIES = {
  fit: "fit (p-value)", distance: "distance (ln of the score)", level: "level in the drag", noise: "level at rest",
};
const unit = ({ quantity }) => (quantity === "level" || quantity === "noise" ? "\u00a0dB" : "");
const number = (value, chart) => `${value.toFixed(2)}${unit(chart)}`.replace("-", "−");

const name = ({ quantity, source, channel }) =>
  source === null ? QUANTITIES[quantity] : `${plain(source)} ${channel}, ${QUANTITIES[quantity]}`;

function shape(tag, attributes, text) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (text !== undefined) element.textContent = text;
  return element;
}

// The text of a chart.
function summary(chart, { needed, within }) {
  if (chart.average === null) return `Not yet known: ${many(chart.scans, "scan")}; it takes ${needed + 1}.`;
  const moved = number(chart.average - chart.centre, chart);
  return `${chart.drifted ? "Drifted" : "No drift"}: moved by ${moved} from ${number(chart.centre, chart)}; up to ${number(chart.limit, chart)} is no drift. `
    + `A change of ${number(chart.finds, chart)} is mostly found within ${within} scans.`;
}

// Values as dots (hollow where the centre is estimated from them), their moving average as a line, the
// limits as dashes. Shapes differ, so that it reads in grey.
function draw(chart, label) {
  const svg = shape("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, class: "control", role: "img", "aria-label": label });
  const { points, centre, limit } = chart;
  const limits = limit === null ? [] : chart.quantity === "fit" ? [centre - limit]
    : chart.quantity === "distance" ? [centre + limit] : [centre - limit, centre + limit];
  const values = points.map(({ value }) => value).concat(limits);
  const [low, high] = [Math.min(...values), Math.max(...values)];
  // A clock that was set back leaves points that are not in order.
  const moments = points.map(({ unix_ms }) => unix_ms);
  const [from, to] = [Math.min(...moments), Math.max(...moments)];
  const x = (ms) => EDGE + ((WIDTH - 2 * EDGE) * (ms - from)) / Math.max(1, to - from);
  const y = (value) => HEIGHT - ROOM - ((HEIGHT - 2 * ROOM) * (value - low)) / Math.max(1e-9, high - low);
  const level = (value, kind) => svg.append(shape("line", { x1: 0, x2: WIDTH, y1: y(value), y2: y(value), class: kind }));
  if (centre !== null) level(centre, "centre");
  for (const value of limits) level(value, "limit");
  for (const { unix_ms, value, average } of points) {
    svg.append(shape("circle", { cx: x(unix_ms), cy: y(value), r: average === null ? 3 : 2.6, class: average === null ? "first" : "later" }));
  }
  const line = points.filter(({ average }) => average !== null).map(({ unix_ms, average }) => `${x(unix_ms)},${y(average)}`);
  svg.append(shape("polyline", { points: line.join(" "), class: "average" }));
  svg.append(
    shape("text", { x: EDGE, y: HEIGHT - 5 }, dated(from)),
    shape("text", { x: WIDTH - EDGE, y: HEIGHT - 5, "text-anchor": "end" }, dated(to)),
    shape("text", { x: EDGE, y: 4, class: "top" }, `${number(low, chart)} to ${number(high, chart)}`),
  );
  return svg;
}

function figure(chart, drift) {
  const box = make("figure");
  const head = make("figcaption");
  head.append(make("strong", name(chart)), make(chart.drifted ? "b" : "span", summary(chart, drift)));
  box.append(head, draw(chart, `${name(chart)}: ${summary(chart, drift)}`));
  return box;
}

function section(reference, drift) {
  const box = make("section");
  box.append(make("h3", reference.surface));
  box.append(make("p", `${many(reference.scans, "scan")} since ${dated(reference.since_unix_ms)}`, "soft"));
  const grid = make("div", undefined, "figures");
  // Charts that have drifted come first; the order is the station's otherwise.
  const charts = [...reference.series].sort((a, b) => b.drifted - a.drifted);
  grid.append(...charts.map((chart) => figure(chart, drift)));
  box.append(grid);
  return box;
}

async function load() {
  const drift = await ask("drift");
  if (!drift) return;
  say("drift-about", `Dots are scans of a part that stays the same; hollow ones, the first ${drift.needed}, tell how the station was. `
    + "The line is their moving average, dashes are its limits.");
  $("drift-body").replaceChildren(...drift.references.map((reference) => section(reference, drift)));
  dialog.dataset.shown = "true";
}

// Shows, on the page itself, whether there are references, and what has drifted.
export function show(references, doubts) {
  hide("drift-open", Object.keys(references).length === 0);
  $("drift-open").dataset.found = String(doubts.length > 0);
  fill("drift-now", doubtLines(doubts).map((line) => make("li", line)));
}

export function changed() {
  if (dialog.open) load();
}

$("drift-open").addEventListener("click", () => go("drift"));
$("drift-close").addEventListener("click", () => dialog.close());
route("drift", dialog, () => {
  opened(dialog);
  load();
});
