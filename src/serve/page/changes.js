// The dialogue of changes: who corrected, kept, enrolled or moved what, the newest first.

import { $, ask, button, dated, hide, make, printable } from "./dom.js";
import { go, opened, route } from "./route.js";

// How many changes are loaded at a time.
const PAGE = 100;
const dialog = $("changes");
let last = null;

const WORDS = {
  correct: "corrected", keep: "made a trial of", enroll: "ordered trials of", "enroll/keep": "kept the refused",
  "enroll/end": "ended the enrolment", move: "moved", rename: "renamed", remove: "removed", restore: "restored",
  undo: "took a step back:", reload: "read the library anew",
};

// The text of a change: old and new value.
function change({ action, before, after }) {
  if (action === "enroll") return `: ${after}`;
  if (before === null && after === null) return action === "correct" ? ": not reviewed" : "";
  if (action === "keep") return `: ${after}`;
  const none = action === "correct" ? "not reviewed" : "the removed trials";
  return `${action === "correct" ? ": " : ""}${before ?? none} → ${after ?? none}`;
}

function line(record) {
  const { unix_ms, person, role, action, subject } = record;
  const item = make("li");
  item.append(make("time", dated(unix_ms)), " ", make("b", person ?? "no name"), ` (${role}) `, `${WORDS[action] ?? action} `);
  if (subject !== null && (action === "correct" || action === "keep")) {
    const open = button(subject, () => go(`scan=${subject}`), "open");
    open.setAttribute("aria-label", printable(`open scan ${subject}, changed ${dated(unix_ms)}, number ${record.id}`));
    item.append(open);
  } else if (subject !== null && subject !== record.before && subject !== record.after) item.append(make("span", subject));
  item.append(make("span", change(record)));
  return item;
}

async function load(before) {
  const said = await ask(`audit?limit=${PAGE}${before === null ? "" : `&before=${before}`}`);
  if (!said) return false;
  const lines = said.changes.map(line);
  if (before === null) $("changes-list").replaceChildren(...lines);
  else $("changes-list").append(...lines);
  last = said.changes.at(-1)?.id ?? last;
  hide("no-changes", $("changes-list").childElementCount > 0);
  hide("changes-older", said.changes.length < PAGE);
  return true;
}

route("changes", dialog, async () => {
  if (await load(null)) opened(dialog);
}, () => $("changes-open"));
$("changes-open").addEventListener("click", () => go("changes"));
$("changes-close").addEventListener("click", () => dialog.close());
$("changes-older").addEventListener("click", () => load(last));
