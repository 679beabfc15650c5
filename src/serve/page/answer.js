// How an answer is put into words.

import { doubtLines, percent, plainLine, times } from "./dom.js";

// The surface that an answer names, or words such as "unknown" if it names none.
export function nameOf(answer) {
  if (answer.state === "unknown") return "unknown";
  if (answer.state === "unnamed") return "not named";
  if (answer.state === "named") return answer.surface;
  return `${answer.state}: ${answer.surface}`;
}

// The probability of each ranked surface; null if the method gives no probabilities. Scores are
// inverse probabilities without the doubt that the library's size leaves; this doubt is spread
// evenly over all surfaces.
export function probabilities({ ranked, confidence }) {
  if (confidence === null || ranked.length === 0) return null;
  const [first, even] = [1 / ranked[0].score, 1 / ranked.length];
  const doubt = first > even ? Math.max(0, (first - confidence) / (first - even)) : 0;
  return ranked.map(({ score }) => (1 - doubt) / score + doubt * even);
}

// How sure an answer is: its probability, or the similarity ratio of first and second surface.
export function sureness(answer) {
  if (answer.state === "unknown" || answer.state === "unnamed") return "";
  return answer.confidence !== null ? percent(answer.confidence) : times(Math.exp(answer.margin));
}

// The damage of a scan, a line each. Older answers list only the reasons why they are spoiled.
export const damageOf = (answer) => (answer.damage ? doubtLines(answer.damage) : answer.spoiled);

// The kinds of doubts that are faults of a sensor, and of those that say that data are missing. Both
// are damage.
const FAULTS = ["stuck", "at_zero", "clipped", "one_colour"];
const LOSSES = [
  "gap", "missing", "picture_lost", "unusable", "wrong_rate", "no_data", "ended_early", "cut",
];

const has = (answer, kinds) => (answer.doubts ?? []).some(({ kind }) => kinds.includes(kind));

// Whether a sensor is at fault; false if data are missing, or nothing is known of an older answer.
export const isFault = (answer) => has(answer, FAULTS);

// Whether the drag was lifted before the time that its library needs.
export const isShort = (answer) => has(answer, ["too_short"]);

// The doubts in words, without damage, which is shown separately, and without the reason for an
// unknown surface or for no surface, which is the state itself. Older answers have only reasons.
function doubts(answer) {
  if (!answer.doubts) return answer.state === "unknown" ? [] : answer.reasons.map(plainLine);
  const own = [...FAULTS, ...LOSSES, "source_missing", "fits_none", "unknown_not_detected"];
  const shown = answer.doubts.filter(({ kind }) => !own.includes(kind));
  if (answer.state === "nearest") shown.push(...answer.doubts.filter(({ kind }) => kind === "unknown_not_detected"));
  return doubtLines(answer.state === "unknown" ? shown.filter(({ kind }) => kind === "too_short") : shown);
}

// An answer as a sentence: how sure it is, or the closest surface, then the reasons for doubt.
export function certainty(answer) {
  const parts = [];
  if (answer.state === "unknown") parts.push(`closest: ${answer.ranked[0]?.surface ?? "nothing"}`);
  else if (answer.state === "unnamed") return answer.reasons.join(" · ");
  else if (answer.confidence === null) {
    parts.push(answer.margin < 0.05 ? "no more alike than the next" : `${sureness(answer)} more alike than the next`);
  } else parts.push(`${sureness(answer)} sure`);
  parts.push(...doubts(answer));
  if (answer.truth) parts.push(answer.truth === answer.surface ? "right" : `it was ${answer.truth}`);
  return parts.join(" · ");
}

// The correction of a scan in words; empty if there is none.
export function corrected(scan) {
  if (!scan.correction) return "";
  const { was, surface } = scan.correction;
  if (was === "bad") return "bad scan";
  if (was === "unknown") return scan.state === "unknown" ? "right: unknown" : "it was unknown";
  return surface === scan.surface ? "right" : `it was ${surface}`;
}
