// Dialogues have addresses: a link opens a dialogue, and Esc or the back button closes it.

const routes = [];

// Opens `dialog` by `show(rest)` at the address `#name=rest` or `#name`. After closing, the focus
// returns to its old element; if that is gone, to the element that `ended` returns.
export function route(name, dialog, show, ended) {
  const one = { name, dialog, show, before: null };
  routes.push(one);
  dialog.addEventListener("close", () => {
    const after = one.before?.isConnected ? one.before : null;
    const other = ended?.();
    one.before = null;
    if (isAt(one)) {
      // Goes back if the page set this address; otherwise (an outside link) shortens the address.
      if (history.state?.inside) history.back();
      else history.replaceState(null, "", location.pathname + location.search);
    }
    (after ?? other)?.focus();
  });
}

const isAt = ({ name }) => location.hash === `#${name}` || location.hash.startsWith(`#${name}=`);

// Opens a dialogue as a new entry in the browser's history.
export function go(address) {
  history.pushState({ inside: true }, "", `#${address}`);
  follow();
}

// Shows a dialogue when its content is ready.
export function opened(dialog) {
  if (dialog.open) return;
  const one = routes.find((other) => other.dialog === dialog);
  one.before = document.activeElement;
  dialog.showModal();
}

export function follow() {
  for (const one of routes) {
    if (isAt(one)) one.show(decodeURIComponent(location.hash.slice(one.name.length + 2)));
    else if (one.dialog.open) one.dialog.close();
  }
}

window.addEventListener("popstate", follow);
