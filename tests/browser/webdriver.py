"""A small WebDriver client: Python's standard library and chromedriver, nothing else.

https://www.w3.org/TR/webdriver2/
"""

import base64
import importlib.util
import json
import shutil
import subprocess
import tempfile
import time
import urllib.error
import urllib.request
from pathlib import Path

ELEMENT = "element-6066-11e4-a52e-4f735466cecf"
# A page from 127.0.0.1 and nothing else; the browser's own errands are off.
ARGUMENTS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--disable-dev-shm-usage", "--hide-scrollbars",
]


class Browser:
    """One Chromium, driven by one chromedriver."""

    def __init__(self, width=1280, height=1000):
        self.profile = tempfile.mkdtemp(prefix="surfaced-browser-")
        self.driver = subprocess.Popen(
            ["chromedriver", "--port=0"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        self.session = None
        for line in self.driver.stdout:
            if "started successfully on port" in line:
                self.base = f"http://127.0.0.1:{line.strip().rstrip('.').split()[-1]}"
                break
        else:
            raise RuntimeError("chromedriver did not start")
        arguments = ARGUMENTS + [f"--user-data-dir={self.profile}", f"--window-size={width},{height}"]
        options = {"args": arguments, "binary": shutil.which("chromium") or "chromium"}
        capabilities = {
            "goog:chromeOptions": options,
            "goog:loggingPrefs": {"browser": "ALL", "performance": "ALL"},
        }
        answer = self.call("POST", "/session", {"capabilities": {"alwaysMatch": capabilities}})
        self.session = f"/session/{answer['sessionId']}"

    def call(self, method, path, body=None):
        data = None if body is None and method != "POST" else json.dumps(body or {}).encode()
        request = urllib.request.Request(self.base + path, data, {"Content-Type": "application/json"}, method=method)
        try:
            with urllib.request.urlopen(request, timeout=60) as answer:
                return json.load(answer)["value"]
        except urllib.error.HTTPError as error:
            said = json.load(error)["value"]["message"].splitlines()[0]
            raise RuntimeError(f"{method} {path}: {said}") from None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        try:
            self.call("DELETE", self.session)
        finally:
            self.driver.terminate()
            self.driver.wait(10)
            shutil.rmtree(self.profile, ignore_errors=True)

    def open(self, url):
        self.call("POST", f"{self.session}/url", {"url": url})

    def run(self, script, *arguments):
        body = {"script": script, "args": list(arguments)}
        return self.call("POST", f"{self.session}/execute/sync", body)

    def text(self, selector):
        return self.run("return document.querySelector(arguments[0])?.innerText ?? null", selector)

    def element(self, selector):
        body = {"using": "css selector", "value": selector}
        return self.call("POST", f"{self.session}/element", body)[ELEMENT]

    def click(self, selector):
        self.call("POST", f"{self.session}/element/{self.element(selector)}/click")

    def open_library(self):
        """Clicks until the library's dialogue is open: scans arrive and move the page, so a click may miss."""
        shown = lambda: self.run("return document.getElementById('shelf').open")
        self.wait("the library", lambda: shown() or self.click("#shelf-open"))

    def type(self, selector, text):
        self.call("POST", f"{self.session}/element/{self.element(selector)}/value", {"text": text})

    def keys(self, text):
        """Presses keys, wherever the focus is."""
        actions = [step for key in text for step in ({"type": "keyDown", "value": key}, {"type": "keyUp", "value": key})]
        body = {"actions": [{"type": "key", "id": "keyboard", "actions": actions}]}
        self.call("POST", f"{self.session}/actions", body)

    def devtools(self, command, **parameters):
        body = {"cmd": command, "params": parameters}
        return self.call("POST", f"{self.session}/goog/cdp/execute", body)

    def resize(self, width, height):
        """The size of the page itself: a window of Chromium has a least width."""
        self.devtools("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def scheme(self, name):
        self.devtools("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": name}])

    def log(self, kind):
        return self.call("POST", f"{self.session}/se/log", {"type": kind})

    def screenshot(self, path, whole=False):
        if whole:
            shot = self.devtools("Page.captureScreenshot", captureBeyondViewport=True, format="png")["data"]
        else:
            shot = self.call("GET", f"{self.session}/screenshot")
        with open(path, "wb") as file:
            file.write(base64.b64decode(shot))

    def accessible(self, where):
        """No rule of axe-core is broken (`pip install axe-core-python`)."""
        axe = Path(importlib.util.find_spec("axe_core_python").origin).with_name("axe.min.js").read_text()
        self.run(axe + "; window.axe = axe;")
        body = {"script": "const done = arguments[0]; axe.run().then(r => done(r.violations.map("
                          "v => [v.id, ...v.nodes.map(n => n.html.slice(0, 150) + ' ' + n.failureSummary)])))", "args": []}
        found = self.call("POST", f"{self.session}/execute/async", body)
        assert not found, f"{where}: {found}"

    @staticmethod
    def wait(what, condition):
        """Waits until `condition()` is true, two minutes at most, and gives its value."""
        end = time.monotonic() + 120
        while True:
            value = condition()
            if value:
                return value
            if time.monotonic() > end:
                raise AssertionError(f"not within two minutes: {what}")
            time.sleep(0.05)
