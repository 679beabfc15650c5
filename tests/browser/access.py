#!/usr/bin/env python3
"""The page for everybody, in headless Chromium: long names at 360 px, the keyboard alone, and the
names that a screen reader gives to what can be pressed or filled in.

    tests/browser/access.py target/release/surfaced [FOLDER FOR SCREENSHOTS]

Needs chromium and chromedriver (Debian: chromium chromium-driver).
"""

from page import ENTER, TAB, on_stage, run
from review import open_newest, shots_of

# Seconds that each synthetic scan lasts.
DRAG = "1.5"
ESCAPE = "\ue00c"
# Labels as long as any may be, and as hard to break.
LONG = ["polyurethane_foam_with_a_coarse_and_open_pored_surface_from_the_workshop_shelf_3",
        "ThermoplasticPolyurethaneElastomerSheetWithHexagonalEmbossingAndAnExtremelyLongName"[:80]]
# What has to have a name.
NAMED = {"button", "link", "textbox", "combobox", "checkbox", "spinbutton", "slider", "image", "img",
         "dialog", "region", "alertdialog", "Video", "Audio"}
# Buttons of the browser's own player and of its fields of dates, below the name of either.
BROWSERS = {"play", "pause", "mute", "unmute", "show more media controls",
            "Show local date and time picker", "Show local date and time picker Show local date and time picker"}


def unnamed(browser):
    """What a screen reader would meet without a name: its role and markup."""
    browser.devtools("Accessibility.enable")
    bad, names = [], {}
    for node in browser.devtools("Accessibility.getFullAXTree")["nodes"]:
        role = node.get("role", {}).get("value", "")
        if node.get("ignored") or role not in NAMED:
            continue
        name = node.get("name", {}).get("value", "").strip()
        names.setdefault((role, name), []).append(node)
        if not name:
            about = browser.devtools("DOM.describeNode", backendNodeId=node["backendDOMNodeId"])["node"]
            bad.append((role, about["nodeName"], about.get("attributes")))
    # Two buttons of one name do the same, or nobody can tell them apart.
    twice = [name for (role, name), nodes in names.items()
             if role == "button" and len(nodes) > 1 and name not in BROWSERS]
    return bad, twice, len(names)


def assert_named(browser, where, least):
    bad, twice, count = unnamed(browser)
    assert not bad, f"{where}: without a name: {bad}"
    assert not twice, f"{where}: buttons of one name: {twice}"
    assert count >= least, f"{where}: {count} named things alone"


CUT = """
const cut = [];
for (const e of document.querySelectorAll('body *')) {
  if (!e.checkVisibility() || e.closest('.hidden, .skip, .scroll, #surfaces, canvas, audio, input, #shelf-trials')) continue;
  const style = getComputedStyle(e);
  const clips = style.overflowX !== 'visible' || style.textOverflow === 'ellipsis';
  if (clips && e.scrollWidth > e.clientWidth + 1) cut.push(e.outerHTML.slice(0, 200));
  const { right } = e.getBoundingClientRect();
  if (right > innerWidth + 1) cut.push(`sticks out to ${right}: ${e.outerHTML.slice(0, 200)}`);
}
return cut;
"""


def long_names_wrap(browser, where):
    """At 360 px nothing sticks out or is cut off, and lists do not scroll sideways."""
    browser.resize(360, 740)
    cut = browser.run(CUT)
    assert not cut, f"{where}: cut off at 360 px: {cut}"
    sideways = browser.run("return [...document.querySelectorAll('.scroll, #surfaces, #shelf-trials')]"
                           ".filter(e => e.checkVisibility() && e.scrollWidth > e.clientWidth + 1).map(e => e.className || e.id)")
    assert not sideways, f"{where}: scrolls sideways at 360 px: {sideways}"
    browser.resize(1280, 1000)


def close(browser, dialog):
    browser.keys(ESCAPE)
    # The address follows some time after.
    browser.wait("the page", lambda: browser.run(
        "return !document.getElementById(arguments[0]).open && location.hash === ''", dialog))


def focused(browser):
    return browser.run("const e = document.activeElement;"
                       "return e.id || e.closest('[data-id]')?.dataset.id || (e.tagName === 'A' ? e.innerText : e.tagName)")


def walk(browser, most=200):
    """What Tab leads to, from the begin of the page until it comes round."""
    browser.run("document.activeElement.blur(); scrollTo(0, 0)")
    seen = []
    for _ in range(most):
        browser.keys(TAB)
        at = focused(browser)
        if at == "BODY" or (seen and at == seen[0]):
            break
        seen.append(at)
        # A skip link shows itself, and a canvas or section is no control.
        outline = browser.run("const s = getComputedStyle(document.activeElement); return [s.outlineStyle, s.outlineWidth]")
        assert outline[0] != "none" and outline[1] != "0px", f"the focus on {at} cannot be seen: {outline}"
    return seen


def by_keyboard_alone(browser, station):
    reached = walk(browser)
    enabled = browser.run(
        "return [...document.querySelectorAll('button, input, a[href], summary')]"
        ".filter(e => e.checkVisibility() && !e.disabled && e.id).map(e => e.id)")
    lacking = [e for e in enabled if e not in reached]
    assert not lacking, f"Tab leads to {reached}, and not to {lacking}"

    # A scan is opened by its row, corrected, and closed; the focus is back on its row.
    scan = browser.run("return document.querySelector('#scans tr').dataset.id")
    browser.run("document.querySelector('#scans button').focus()")
    browser.keys(ENTER)
    browser.wait("the scan", lambda: browser.run("return document.getElementById('scan').open"))
    for _ in range(30):
        if focused(browser) == "was":
            break
        browser.keys(TAB)
    assert focused(browser) == "was", "Tab leads to the correction"
    browser.keys("slate" + ENTER)
    browser.wait("the correction", lambda: "it was slate" in (browser.text("#was-now") or ""))
    close(browser, "scan")
    browser.wait("the focus back", lambda: focused(browser) == scan)

    # The library likewise.
    browser.run("document.getElementById('shelf-open').focus()")
    browser.keys(ENTER)
    browser.wait("the trials", lambda: browser.run("return document.querySelectorAll('#shelf-trials tbody tr').length > 4"))
    browser.run("document.querySelector('#shelf-trials .acts button').focus()")
    browser.keys(ENTER)
    browser.wait("the new label's field", lambda: focused(browser) == "relabel-to")
    close(browser, "shelf")
    browser.wait("the focus back", lambda: focused(browser) == "shelf-open")


def check(browser, station, shots):
    browser.resize(1280, 1000)
    browser.open(station.url + "/")
    browser.wait("scans", lambda: browser.run("return document.querySelectorAll('#scans tr').length") >= 2)
    browser.wait("a name on the page", lambda: any(name in browser.text("#now") for name in LONG))

    by_keyboard_alone(browser, station)
    browser.wait("precision", lambda: browser.run("return !document.getElementById('precision-box').hidden"))
    browser.run("document.getElementById('precision-box').open = true")
    assert_named(browser, "the page", 20)
    long_names_wrap(browser, "the page")
    shots_of(browser, shots, "long-page")

    # Unknown is a state of its own, with its reason.
    browser.run("document.querySelector('#scans tr.unknown button').click()")
    browser.wait("the scan", lambda: browser.run("return document.getElementById('scan').dataset.shown"))
    about = browser.text("#scan-about")
    assert browser.text("#scan-title") == "unknown" and "closest: " in about, about
    assert "differs too much from" in browser.text("#scan-body section"), "unknown, with its reason"
    close(browser, "scan")

    open_newest(browser, station)
    assert_named(browser, "a scan", 12)
    long_names_wrap(browser, "a scan")
    shots_of(browser, shots, "long-scan")
    close(browser, "scan")

    browser.open_library()
    browser.click("#check")
    browser.wait("the check", lambda: browser.run("return document.getElementById('shelf').dataset.check") == "done")
    browser.run("document.querySelectorAll('#shelf details').forEach(d => d.open = true)")
    assert_named(browser, "the library", 12)
    long_names_wrap(browser, "the library")
    shots_of(browser, shots, "long-library")
    close(browser, "shelf")
    console = browser.log("browser")
    assert not console, f"the console stays empty: {console}"


def long_names(surfaced, library, _data):
    surfaces = sorted(path.name for path in library.iterdir() if path.is_dir())
    for surface, name in zip(surfaces, LONG):
        run(surfaced, "library", "rename", library, surface, name)


def main():
    on_stage(check, long_names, trials="30", users="0", kept=6, seconds=DRAG)
    print("the page is for everybody")


if __name__ == "__main__":
    main()
