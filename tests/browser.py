"""What the tests of pages share: a page as a browser would read it, and a browser."""

import json
import re
import shutil
import subprocess
from html.parser import HTMLParser

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


class Page(HTMLParser):
    """What a browser would see: tags, their attributes, and the texts of scripts."""

    def __init__(self, words):
        super().__init__()
        self.tags, self.scripts, self.inside = [], [], False
        self.feed(words)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        self.inside = tag == "script"
        if self.inside:
            self.scripts.append("")

    def handle_endtag(self, tag):
        self.inside = False

    def handle_data(self, words):
        if self.inside:
            self.scripts[-1] += words

    @property
    def data(self):
        return json.loads(self.scripts[0])


PROBE = """
<script>
window.onerror = (message) => { document.title = "error: " + message; };
setTimeout(() => {
  const found = {};
  try { CHECK } catch (error) { found.error = String(error); }
  document.body.replaceChildren(document.createElement("pre"));
  document.querySelector("pre").id = "found";
  document.querySelector("pre").textContent = JSON.stringify(found);
}, 50);
</script></body>"""


def browsed(page, check, tmp_path):
    """What the JavaScript ``check`` puts into ``found`` in a headless browser, and its console."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip("no browser: chromium or google-chrome is not installed")
    path = tmp_path / "probe.html"
    path.write_text(page.replace("</body>", PROBE.replace("CHECK", check)), encoding="utf-8")
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr"]
    command += [f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=2000"]
    done = subprocess.run(
        [*command, "--dump-dom", path.as_uri()], capture_output=True, text=True, timeout=60
    )
    assert "CONSOLE" not in done.stderr and "<title>error" not in done.stdout, done.stderr
    seen = re.search(r'<pre id="found">(.*?)</pre>', done.stdout, re.DOTALL)
    return json.loads(Page(f"<script>{seen[1]}</script>").scripts[0])
