// The dialogue of one scan: its signals, the reasons for its name, and a form to correct the name.

import { certainty, corrected, damageOf, nameOf, probabilities } from "./answer.js";
import { spectra, traces } from "./chart.js";
import { $, ask, clock, fill, hide, make, many, percent, plain, plainLine, say, sourceName } from "./dom.js";
import { opened, route } from "./route.js";

const dialog = $("scan");
let open = null;
// How often a scan was asked for, and corrected.
let loads = 0;
let corrections = 0;

const digits = (p) => (p === null ? "none" : p.toFixed(p < 0.1 ? 3 : 2));

function heading(text) {
  return make("h3", text);
}

// The vote of a source, as a bar: to the left for the winner, to the right for the runner-up.
function says(source, most) {
  const item = make("li");
  const bar = make("div", undefined, "weigh");
  const part = make("i", undefined, source.for_winner < 0 ? "against" : "for");
  part.style.width = `${(50 * Math.abs(source.for_winner ?? 0)) / most}%`;
  bar.append(part);
  const value = source.for_winner === null ? "" : Math.abs(source.for_winner).toFixed(1);
  item.append(sourceName(source.source, "span"), bar, make("b", value));
  const alone = `alone it would say ${source.alone ?? "nothing"}`;
  item.append(make("small", alone));
  return item;
}

// Least evidence of a source that counts as a vote: natural logarithm of odds of 1.6 to 1.
const SPEAKS = 0.5;

function list(sources, ending) {
  const names = sources.map(({ source }) => plain(source));
  const all = names.length > 1 ? `${names.slice(0, -1).join(", ")} and ${names.at(-1)}` : names[0];
  return `${all} ${names.length > 1 ? ending : `${ending}s`}`;
}

// The votes of all sources as a sentence.
function votes({ winner, runner_up, sources }) {
  const speaks = (least) => sources.filter(({ for_winner: by }) => by !== null && (least > 0 ? by >= least : by <= least));
  const [pro, contra] = [speaks(SPEAKS), speaks(-SPEAKS)];
  const parts = [];
  if (pro.length) parts.push(`${list(pro, "speak")} for ${winner}`);
  if (contra.length) parts.push(`${list(contra, "speak")} against it, for ${runner_up}`);
  if (parts.length === 0) parts.push(`no source tells ${winner} from ${runner_up}`);
  const text = parts.join("; ");
  return `${text[0].toUpperCase()}${text.slice(1)}.`;
}

// How well the scan fits its surface, compared with left-out trials of the library.
function fit({ winner, p_value: p, threshold, threshold_trials: trials }, unknown) {
  if (threshold === null) return "Unknown surfaces are not detected: the library has too few trials.";
  if (p === null) return "It is too short, or lacks a source, to tell a known surface from an unknown one.";
  const stranger = Math.max(0, Math.round(p * (trials + 1)) - 1);
  const of = `${stranger === 0 ? "None" : `Only ${stranger}`} of the library's ${many(trials, "trial")}`;
  if (unknown) return `It differs too much from ${winner}, the closest surface. ${of} differ as much from their own surface.`;
  return `It fits ${winner}: ${stranger} of the library's ${many(trials, "trial")} differ more from their own surface.`;
}

function reasons(scan, why) {
  const box = make("section");
  box.append(heading("Why"));
  const voted = why.sources.length > 0 && why.runner_up !== null;
  box.append(make("p", fit(why, scan.state === "unknown")));
  if (voted && scan.state !== "unknown") box.append(make("p", votes(why)));
  for (const reason of scan.state === "unknown" ? [] : scan.reasons) box.append(make("p", plainLine(reason)));
  for (const line of why.left_out) box.append(make("p", `Not compared: ${plainLine(line)}`, "soft"));
  const figures = make("details");
  figures.append(make("summary", "Figures"));
  if (why.threshold !== null) {
    figures.append(make("p", `p = ${digits(why.p_value)}; ${digits(why.threshold)} or less is unknown (from ${why.threshold_trials} left-out trials)`));
  }
  if (voted) {
    const legend = make("p", undefined, "versus");
    legend.append(make("span", `for ${why.winner}`, "for"), make("span", `for ${why.runner_up}`, "against"));
    const most = Math.max(1e-9, ...why.sources.map((source) => Math.abs(source.for_winner ?? 0)));
    const bars = make("ul", undefined, "says");
    bars.setAttribute("aria-label", `what each source says for ${why.winner} and for ${why.runner_up}, in natural logarithms of odds`);
    bars.append(...why.sources.map((source) => says(source, most)));
    figures.append(legend, bars);
  }
  figures.append(ranking(scan));
  box.append(figures);
  return box;
}

function ranking(scan) {
  const box = make("section");
  if (scan.ranked.length === 0) return box;
  box.append(heading("Ranking"));
  const list = make("ol", undefined, "ranking");
  const shares = scan.state === "unknown" ? null : probabilities(scan);
  scan.ranked.slice(0, 8).forEach(({ surface, score }, at) => {
    const item = make("li");
    const closest = at === 0 ? "closest" : "";
    const text = scan.state === "unknown" ? closest : shares ? percent(shares[at]) : score.toPrecision(3);
    item.append(make("span", surface), make("b", text));
    list.append(item);
  });
  box.append(list);
  return box;
}

function signal(scan, own, nearest) {
  const figure = make("figure");
  const head = make("figcaption");
  head.append(sourceName(own.source), make("span", `${own.duration_s.toFixed(2)} s at ${own.rate_hz.toLocaleString("en")} Hz`));
  if (own.audible) {
    const sound = make("audio");
    sound.controls = true;
    sound.preload = "none";
    sound.src = `api/v1/scans/${scan.id}/${own.source}.wav`;
    sound.setAttribute("aria-label", `play ${plain(own.source)}`);
    head.append(sound);
  }
  figure.append(head, traces(own.source, own, nearest));
  if (own.spectrum) figure.append(spectra(own.source, own, nearest));
  return figure;
}

function picture(source, path, caption) {
  const figure = make("figure", undefined, "picture");
  const image = make("img");
  image.src = path;
  image.alt = `${source} of ${caption}`;
  figure.append(image, make("figcaption", `${plain(source)}, ${caption}`));
  return figure;
}

function signals(scan, { scan: own, nearest, no_nearest: noNearest }) {
  const box = make("section");
  box.append(heading("Signals"));
  if (nearest) {
    const { surface, user, number } = nearest.trial;
    const legend = make("p", undefined, "legend");
    legend.append(make("span", "this scan", "own"), make("span", `nearest trial: ${surface}, ${user}, ${number}`, "nearest"));
    box.append(legend);
  }
  if (noNearest) box.append(make("p", `Nearest trial: ${noNearest}.`, "empty"));
  const grid = make("div", undefined, "figures");
  const of = (source) => nearest?.series.find((other) => other.source === source) ?? null;
  grid.append(...own.series.map((series) => signal(scan, series, of(series.source))));
  for (const source of own.pictures) {
    grid.append(picture(source, `api/v1/scans/${scan.id}/${source}.png`, "this scan"));
    if (nearest?.pictures.includes(source)) {
      grid.append(picture(source, `api/v1/scans/${scan.id}/nearest-${source}.jpg`, "the nearest trial"));
    }
  }
  box.append(grid);
  return box;
}

// Shows the correction of a scan, and the forms to change it.
function showCorrection(scan) {
  const spoiled = scan.spoiled.length > 0;
  const by = (person) => (person ? ` (${person})` : "");
  const parts = [scan.correction ? `${corrected(scan)}${by(scan.correction.person)}` : "Not reviewed yet."];
  if (scan.became) parts.push(`trial ${scan.became}${by(scan.became_by)}`);
  else if (scan.became_by) parts.push(`no longer a trial${by(scan.became_by)}`);
  else if (scan.correction?.was === "surface" && spoiled) parts.push("it is spoiled, so it cannot become a trial");
  say("was-now", parts.join(" · "));
  hide("was-right", scan.surface === null);
  hide("was-clear", !scan.correction);
  hide("keep-form", scan.correction?.was !== "surface" || Boolean(scan.became) || !scan.kept || spoiled);
}

function showHead(scan) {
  say("scan-title", nameOf(scan));
  const when = new Date(scan.unix_ms).toLocaleDateString("en-GB", { day: "numeric", month: "long" });
  say("scan-about", `scan ${scan.scan}, ${when} ${clock(scan.unix_ms)} · ${certainty(scan)} · answered in ${scan.latency_ms.toFixed(0)} ms`);
  fill("scan-damage", damageOf(scan).map((line) => make("li", line)));
  showCorrection(scan);
}

async function load(id) {
  loads += 1;
  const [own, before, wanted] = [loads, corrections, location.hash];
  const found = await ask(`scans/${encodeURIComponent(id)}`);
  // Stops if the dialogue was closed in the meantime, or shows another scan or this one anew.
  if (!found || own !== loads || location.hash !== wanted) return;
  // A correction that was made in the meantime is newer than what was found.
  const scan = before !== corrections && open?.id === found.id ? open : found;
  if (open?.id !== scan.id) $("was").value = "";
  open = scan;
  showHead(scan);
  const body = $("scan-body");
  body.replaceChildren();
  opened(dialog);
  if (!scan.kept) {
    body.append(ranking(scan), make("p", "The signals of this scan are not kept (any more).", "empty"));
    return;
  }
  const notes = await ask(`scans/${scan.id}/why`);
  if (own !== loads || open?.id !== scan.id) return;
  // Scans just before the station's end, or in quick succession, have no explanation.
  if (!notes) {
    body.append(ranking(scan));
    return;
  }
  body.append(notes.why ? reasons(scan, notes.why) : ranking(scan), signals(scan, notes));
  dialog.dataset.shown = scan.id;
}

async function correct(was, step = "correct") {
  const scan = await ask(`scans/${open.id}/${step}`, was);
  if (!scan) return;
  corrections += 1;
  open = scan;
  showHead(scan);
}

route("scan", dialog, load, () => {
  // A correction draws the row again, so the button must be looked up.
  const row = open && `#scans tr[data-id="${CSS.escape(open.id)}"] button`;
  open = null;
  delete dialog.dataset.shown;
  return row && document.querySelector(row);
});
$("scan-close").addEventListener("click", () => dialog.close());
$("was-right").addEventListener("click", () => correct({ surface: open.surface }));
$("was-unknown").addEventListener("click", () => correct({ unknown: true }));
$("was-bad").addEventListener("click", () => correct({ bad: true }));
$("was-clear").addEventListener("click", () => correct({}));
$("was-form").addEventListener("submit", (event) => {
  event.preventDefault();
  correct({ surface: $("was").value });
});
$("keep-form").addEventListener("submit", (event) => {
  event.preventDefault();
  correct({ user: $("keep-user").value }, "keep");
});
window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => open && load(open.id));
