// Small helpers for all parts of the page. Text from outside is inserted as text, never as markup.

export const $ = (id) => document.getElementById(id);

// Invisible characters that change how text is shown, such as reversing it (see printable.rs).
const UNSEEN = /[\u0000-\u0008\u000b-\u001f\u007f-\u009f\u061c\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb]|[\u{e0000}-\u{e007f}]/gu;
export const printable = (text) => String(text).replace(UNSEEN, (c) => `\\u{${c.codePointAt(0).toString(16)}}`);

// Places where a long name may break: after `_` and `/`, and before capital letters within a word. The
// browser already breaks at hyphens and spaces.
const JOINTS = /(?<=[\p{L}\p{N}][_/])(?=[\p{L}\p{N}])|(?<=\p{Ll}{2})(?=\p{Lu}\p{Ll})/u;

// The parts of a name between these places.
export const parts = (text) => printable(text).split(JOINTS);

function write(element, text) {
  element.replaceChildren(...parts(text).flatMap((part, at) => (at ? [document.createElement("wbr"), part] : [part])));
}

export function make(tag, text, className) {
  const element = document.createElement(tag);
  if (text !== undefined) write(element, text);
  if (className) element.className = className;
  return element;
}

// A share in per cent. Values near 1 are rounded down, so that none looks like certainty.
export const percent = (share) =>
  `${share > 0.995 && share < 1 ? (Math.floor(share * 1000) / 10).toFixed(1) : (share * 100).toFixed(0)}\u00a0%`;
export const many = (count, what) => `${count} ${what}${count === 1 ? "" : "s"}`;
export const clock = (ms) => new Date(ms).toLocaleTimeString("en-GB");

// The time of day; before today, with its date.
export function dated(ms) {
  const today = new Date().toDateString() === new Date(ms).toDateString();
  return today ? clock(ms) : `${new Date(ms).toLocaleDateString("en-GB", { day: "numeric", month: "short" })} ${clock(ms)}`;
}

// Every time of the page is in this zone, which its foot names.
export const zone = () => {
  const { timeZone } = Intl.DateTimeFormat().resolvedOptions();
  const offset = -new Date().getTimezoneOffset();
  const sign = offset < 0 ? "−" : "+";
  const [hours, minutes] = [Math.floor(Math.abs(offset) / 60), Math.abs(offset) % 60].map((part) => String(part).padStart(2, "0"));
  if (timeZone === "UTC") return "times: UTC";
  return `times: ${timeZone}, UTC${sign}${hours}:${minutes}`;
};

// Shows a list of elements in a place; does nothing if the place shows the same already.
export function fill(id, elements) {
  const place = $(id);
  const text = elements.map((element) => element.outerHTML).join("");
  if (place.dataset.text === text) return;
  place.dataset.text = text;
  place.replaceChildren(...elements);
}

export function say(id, text) {
  if ($(id).textContent !== printable(text)) write($(id), text);
}

export function hide(id, hidden) {
  $(id).hidden = hidden;
}

export const times = (ratio) => (ratio >= 1000 ? "> 1000 ×" : `${ratio.toFixed(ratio < 10 ? 1 : 0)} ×`);

const SOURCES = {
  ac: "acceleration", fr: "force", ir: "infrared", me: "metal detector", mi1: "tap sound", mi2: "sound",
  sound: "microphone", ca1: "picture", ca2: "picture with flash",
};

// The plain name of a source. `plainLine` replaces the source at the start of a line by this name.
export const plain = (source) => SOURCES[source] ?? source;
export const plainLine = (line) => line.replace(/^[a-z]+\d?(?=[: ])/, plain);

// An element with the plain name of a source, and its id in small letters.
export function sourceName(source, tag = "strong") {
  const element = make(tag, plain(source));
  if (plain(source) !== source) element.append(" ", make("small", source));
  return element;
}

// Doubts, or damage, as lines with the plain names of sources.
export const doubtLines = (doubts) =>
  doubts.map(({ source, text }) => (source ? `${plain(source)}: ${text}` : text));

// A button that runs `act`.
export function button(text, act, className) {
  const element = make("button", text, className);
  element.type = "button";
  element.addEventListener("click", act);
  return element;
}

// Longer than the station takes for any answer; a network that swallows a request never ends it.
const ANSWER_WITHIN_MS = 15_000;

// The headers of each command; `person.js` adds the person.
export const commandHeaders = { "Content-Type": "application/json" };

// Sends a request and returns the station's answer; if it is refused, shows why and returns null.
export async function ask(path, body) {
  let problem = "";
  let said = null;
  const signal = AbortSignal.timeout(ANSWER_WITHIN_MS);
  try {
    const request = body === undefined ? { signal } : {
      signal,
      method: "POST",
      headers: commandHeaders,
      body: JSON.stringify(body),
    };
    const answer = await fetch(`api/v1/${path}`, request);
    said = await answer.json();
    if (!answer.ok) [problem, said] = [said.message, null];
  } catch {
    problem = "The station does not answer; is it still running?";
  }
  for (const id of ["problem", "dialog-problem", "shelf-problem", "changes-problem", "drift-problem"]) {
    hide(id, problem === "");
    say(id, problem);
  }
  return said;
}
