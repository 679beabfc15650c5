// How an answer is put into words.

import { percent, times } from "./dom.js";

// What stands in the place of the name.
export function nameOf(answer) {
  if (answer.state === "unknown") return "unknown";
  if (answer.state === "unnamed") return "not named";
  if (answer.state === "named") return answer.surface;
  return answer.state === "unsure" ? `unsure: ${answer.surface}` : `nearest: ${answer.surface}`;
}

// How sure an answer is: by its probability where the method gives one.
export function sureness(answer) {
  if (answer.state !== "named" && answer.state !== "unsure") return "";
  return answer.confidence !== null ? percent(answer.confidence) : times(Math.exp(answer.margin));
}

// The same as a sentence, with the reasons for doubt.
export function certainty(answer) {
  const parts = [];
  if (answer.state === "unknown") parts.push(`nearest: ${answer.ranked[0]?.surface ?? "nothing"}`);
  else if (answer.state === "unnamed") return answer.reasons.join(" · ");
  else if (answer.confidence === null) {
    parts.push(answer.margin < 0.05 ? "no more alike than the next" : `${times(Math.exp(answer.margin))} more alike than the next`);
  } else if (answer.state === "named") parts.push(`${sureness(answer)} sure`);
  parts.push(...answer.reasons.filter((reason) => !answer.spoiled.includes(reason)));
  parts.push(`answered in ${answer.latency_ms.toFixed(0)} ms`);
  if (answer.truth) parts.push(answer.truth === answer.surface ? "right" : `it was ${answer.truth}`);
  return parts.join(" · ");
}

// What somebody said a scan was.
export function corrected(scan) {
  if (!scan.correction) return "";
  const { was, surface } = scan.correction;
  if (was === "bad") return "bad scan";
  if (was === "unknown") return scan.state === "unknown" ? "right: unknown" : "it was unknown";
  return surface === scan.surface ? "right" : `it was ${surface}`;
}
