// How right the answers are that somebody corrected, surface by surface.

import { $, ask, hide, make, percent, say } from "./dom.js";

function row({ surface, corrected, right, precision, precision_low, precision_high }) {
  const line = make("tr");
  const name = make("th", surface ?? "unknown");
  name.scope = "row";
  line.append(name, make("td", right), make("td", corrected), make("td", percent(precision)),
    make("td", `${percent(precision_low)} to ${percent(precision_high)}`));
  return line;
}

// Reads the figures anew; without corrections there are none.
export async function load() {
  const said = await ask("history");
  if (!said) return;
  const found = said.precision;
  hide("precision-box", found.length === 0);
  const sum = (of) => found.reduce((all, surface) => all + surface[of], 0);
  say("precision-sum", `Corrected answers: ${sum("right")} right of ${sum("corrected")}`);
  $("precision").replaceChildren(...found.map(row));
}
