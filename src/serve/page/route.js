// Dialogues by their addresses: a link opens one, Esc and the back button close it.

const routes = [];

// Opens `dialog` with `show(rest)` where the address is `#name=rest` or `#name`; `ended` gives the
// element that has the focus after it, if what had it before is gone.
export function route(name, dialog, show, ended) {
  const one = { name, dialog, show, before: null };
  routes.push(one);
  dialog.addEventListener("close", () => {
    const after = one.before?.isConnected ? one.before : null;
    const other = ended?.();
    one.before = null;
    if (isAt(one)) {
      // A step of the page itself is taken back; an address that came from elsewhere is shortened.
      if (history.state?.inside) history.back();
      else history.replaceState(null, "", location.pathname + location.search);
    }
    (after ?? other)?.focus();
  });
}

const isAt = ({ name }) => location.hash === `#${name}` || location.hash.startsWith(`#${name}=`);

// Opens a dialogue, one step further.
export function go(address) {
  history.pushState({ inside: true }, "", `#${address}`);
  follow();
}

// Shows a dialogue whose content is there.
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
