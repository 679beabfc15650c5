// Who works here: the role that the token gives, and a name, asked once a shift, that goes with each
// command. Nothing waits for the name.

import { $, ask, commandHeaders, hide, say } from "./dom.js";

const KEY = "surfaced-person";
const SHIFT_MS = 10 * 3600 * 1000;
const LOOK_EVERY_MS = 60_000;
// Where the browser stores nothing, the name is known until the page is left.
let held = null;

// The answer of this shift, `{ name, until }`, where no name means that it was skipped; else null.
function known() {
  try {
    held = JSON.parse(localStorage.getItem(KEY)) ?? held;
  } catch {
    // The browser may refuse to store anything, or hold something else there.
  }
  return held?.until > Date.now() ? held : null;
}

function keep(name) {
  held = { name, until: Date.now() + SHIFT_MS };
  try {
    localStorage.setItem(KEY, JSON.stringify(held));
  } catch {
    // See `known`.
  }
  show();
}

function show() {
  const said = known();
  const name = String(said?.name ?? "").toWellFormed();
  hide("person-form", said !== null);
  hide("person-known", said === null);
  if (name) commandHeaders["X-Surfaced-Person"] = encodeURIComponent(name);
  else delete commandHeaders["X-Surfaced-Person"];
  say("person-text", name ? `Changes are made by ${name}.` : "Changes are made without a name.");
}

// Asks the station for the role of this page, which hides what an operator may not do.
export async function learnRole() {
  const me = await ask("me");
  if (me) document.body.dataset.role = me.role;
}

$("person-form").addEventListener("submit", (event) => {
  event.preventDefault();
  const name = $("person-name").value.trim();
  if (name === "") return;
  keep(name);
  $("person-change").focus();
});
$("person-skip").addEventListener("click", () => {
  keep("");
  $("person-change").focus();
});
$("person-change").addEventListener("click", () => {
  hide("person-form", false);
  hide("person-known", true);
  $("person-name").value = known()?.name ?? "";
  $("person-name").focus();
});
// Another tab of this browser may have been told, and a shift ends. A form in use is left alone.
setInterval(() => $("person-form").contains(document.activeElement) || show(), LOOK_EVERY_MS);
show();
