"""Tests the page of `densify view` in a real browser: headless Chromium, driven through chromedriver.

    python view.py DENSIFY RUN OTHER [FOLDER FOR SCREENSHOTS]          needs chromium and chromium-driver

RUN and OTHER are runs on the same scene, and RUN must have test views. WebDriver is JSON over HTTP, for which
Python's standard library suffices.
"""

import base64
import json
import signal
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

STEPS = 50
PATIENCE = 60.0
# Statistics of a thumbnail of the stage, which distinguish pictures from each other and from empty ones.
PROBE = """
const small = document.createElement("canvas");
small.width = small.height = 48;
const out = small.getContext("2d", { willReadFrequently: true });
out.drawImage(document.getElementById("picture"), 0, 0, 48, 48);
const { data } = out.getImageData(0, 0, 48, 48);
const light = [], colours = new Set();
for (let i = 0; i < data.length; i += 4) {
  light.push(data[i] + data[i + 1] + data[i + 2]);
  colours.add([0, 1, 2].map((c) => data[i + c] >> 5).join());
}
const mean = light.reduce((a, b) => a + b) / light.length;
return { spread: Math.sqrt(light.reduce((a, b) => a + (b - mean) ** 2, 0) / light.length), light: light.join(), colours: colours.size };
"""
# The PSNR [dB] between the bytes of two pictures of one size.
DECIBELS = """
const decibels = (a, b) => {
  const sum = a.reduce((sum, x, i) => sum + (x - b[i]) ** 2, 0);
  return 10 * Math.log10(255 ** 2 / Math.max(sum / (a.length * 3 / 4), 1e-9));
};
"""
# The PSNR [dB] between the picture on the right and a PNG of the same size.
PSNR = DECIBELS + """
const done = arguments[arguments.length - 1], image = new Image();
image.onload = () => {
  const { bitmap } = shown[1];
  const [a, b] = [bitmap, image].map((it) => {
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [it.width, it.height];
    canvas.getContext("2d").drawImage(it, 0, 0);
    return canvas.getContext("2d").getImageData(0, 0, it.width, it.height).data;
  });
  done(a.length === b.length ? decibels(a, b) : 0);
};
image.src = arguments[0];
"""
# The PSNR [dB] between the middle of the stage now and at the last call.
MIDDLE_PSNR = DECIBELS + """
const { width, height } = picture, side = Math.round(height / 3);
const copy = document.createElement("canvas"), out = copy.getContext("2d", { willReadFrequently: true });
[copy.width, copy.height] = [side, side];
out.drawImage(picture, Math.round((side - width) / 2), Math.round((side - height) / 2));
const { data } = out.getImageData(0, 0, side, side), before = window.middle ?? data;
window.middle = data;
return decibels(data, before);
"""
# The number of pixels of the marks over the picture.
MARK_PIXELS = """
const copy = document.createElement("canvas"), out = copy.getContext("2d", { willReadFrequently: true });
[copy.width, copy.height] = [marks.width, marks.height];
out.drawImage(marks, 0, 0);
const { data } = out.getImageData(0, 0, copy.width, copy.height);
return data.filter((value, i) => i % 4 === 3 && value).length;
"""
# The position of a camera's mark, and the camera that a click there goes to.
CAMERA_MARK = """
const places = allViews().map(({ split, number }) => projector()(frustum(scene.views[split][number])[0]));
const [width, height] = area();
const [x, y] = places.find(([x, y, z]) => z > 0 && x > 20 && y > 60 && x < width - 120 && y < height - 60).map(Math.round);
return [x, y, cameraAt(x, y)];
"""
# Visible controls that cannot be reached with the keyboard, or that have no name.
UNREACHABLE = """
const seen = [...document.querySelectorAll("button, select, input, summary, [tabindex]")]
  .filter((it) => it.offsetParent !== null && !it.disabled && (it.type !== "radio" || it.checked));
const name = (it) => it.ariaLabel || it.labels?.[0]?.textContent || it.textContent;
return seen.filter((it) => !it.dataset.reached || !name(it).trim()).map((it) => it.id || it.outerHTML);
"""
# Pairs of the given elements that overlap.
OVERLAPS = """
const boxes = arguments[0].map((id) => [id, document.getElementById(id).getBoundingClientRect()]);
const crosses = (a, b) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;
return boxes.flatMap(([id, box], i) => boxes.slice(i + 1).filter(([, other]) => crosses(box, other)).map(([other]) => `${id} and ${other}`));
"""
# Turns the scene with every frame of the screen for some seconds; returns the pictures shown per second, the rate that
# the page reports, and the pictures' widths.
TURN = """
const done = arguments[arguments.length - 1], stage = document.getElementById("stage"), begun = performance.now();
const pictures = () => Number(stage.dataset.pictures), widths = [], before = pictures();
let last = before;
const turn = (now) => {
  if (now - begun > 1000 * arguments[0]) {
    const rate = (pictures() - before) / (performance.now() - begun) * 1000;
    return done({ rate, reported: Number(stage.dataset.rate), widths });
  }
  orbit(0.012, 0.002 * Math.sin(now / 700));
  if (pictures() !== last) {
    last = pictures();
    widths.push(Number(stage.dataset.size.split("x")[0]));
  }
  requestAnimationFrame(turn);
};
requestAnimationFrame(turn);
"""
# The size that the page chooses for coarse pictures, relative to full size, after a picture of size 0.5 and 1000 bytes
# at a microsecond per byte. Arguments [ms]: the time to render that picture, the time until it arrived, the latency.
COARSE_SIZE = """
const [milliseconds, took, knownLatency] = arguments;
[latency, perByte] = [knownLatency, 1e-3];
pace([{ bitmap: { width: 1, height: 1 }, bytes: 1000, milliseconds, held: milliseconds, took }], performance.now() - took, true, 0.5);
return coarse;
"""
# Delays every reply by a number of milliseconds, like a slow network; also records the largest number of requests under
# way at once.
DELAY = """
const undelayed = window.fetch;
window.fetch = async (...request) => {
  window.atOnce = Math.max(window.atOnce ?? 0, underway);
  const answer = await undelayed(...request);
  await new Promise((resolve) => setTimeout(resolve, arguments[0]));
  return answer;
};
"""


class Browser:
    """A session of chromedriver."""

    def __init__(self) -> None:
        self.driver = subprocess.Popen(["chromedriver", "--port=0"], stdout=subprocess.PIPE, text=True)
        assert self.driver.stdout
        line = next(line for line in self.driver.stdout if "started successfully on port" in line)
        port = line.rsplit("port", 1)[1].strip(" .\n")
        self.base = f"http://127.0.0.1:{port}"
        options = {"args": ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--window-size=1280,800"]}
        wanted = {"goog:chromeOptions": options, "goog:loggingPrefs": {"browser": "ALL", "performance": "ALL"}}
        session = self.call("POST", "/session", {"capabilities": {"alwaysMatch": wanted}})
        self.session = f"/session/{session['sessionId']}"

    def call(self, method: str, path: str, body: object = None) -> object:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self.base + path, data, {"Content-Type": "application/json"}, method=method)
        try:
            with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
                return json.load(answer)["value"]
        except urllib.error.HTTPError as error:
            raise SystemExit(f"{method} {path}: {error.read().decode()}") from error

    def open(self, url: str) -> None:
        self.call("POST", f"{self.session}/url", {"url": url})

    def run(self, script: str, *arguments: object) -> object:
        return self.call("POST", f"{self.session}/execute/sync", {"script": script, "args": list(arguments)})

    def run_async(self, script: str, *arguments: object) -> object:
        """Runs a script that calls its last argument when it has finished."""
        return self.call("POST", f"{self.session}/execute/async", {"script": script, "args": list(arguments)})

    def command(self, name: str, **parameters: object) -> None:
        """Runs a command of the DevTools."""
        self.call("POST", f"{self.session}/goog/cdp/execute", {"cmd": name, "params": parameters})

    def wait_for(self, condition: str, message: str) -> None:
        end = time.monotonic() + PATIENCE
        while not self.run(f"return Boolean({condition})"):
            assert time.monotonic() < end, f"{message}: {self.run('return document.body.innerText')}"
            time.sleep(0.02)

    def wait_until_sharp(self) -> None:
        self.wait_for("document.getElementById('stage').dataset.state === 'sharp'", "no sharp picture")

    def choose(self, name: str, value: str) -> None:
        """Selects an option of a list, like a user."""
        script = "const list = document.getElementById(arguments[0]); list.value = arguments[1];"
        script += "list.dispatchEvent(new Event('change', { bubbles: true })); return list.value;"
        assert self.run(script, name, value) == value, f"{name} has no {value}"
        self.wait_until_sharp()

    def press(self, *names: str) -> None:
        actions = [{"type": kind, "value": name} for name in names for kind in ("keyDown", "keyUp")]
        self.call("POST", f"{self.session}/actions", {"actions": [{"type": "key", "id": "keys", "actions": actions}]})

    def mouse(self, *actions: dict) -> None:
        pointer = {"type": "pointer", "id": "hand", "parameters": {"pointerType": "mouse"}, "actions": list(actions)}
        self.call("POST", f"{self.session}/actions", {"actions": [pointer]})

    def pinch(self, *places: tuple[int, int]) -> None:
        """Moves two fingers: places 0 and 1 are where they start, places 2 and 3 where they end."""
        sources = []
        for finger, (at, to) in enumerate([(places[0], places[2]), (places[1], places[3])]):
            move = lambda place, duration: {"type": "pointerMove", "duration": duration, "x": place[0], "y": place[1]}
            actions = [move(at, 0), {"type": "pointerDown"}, move(to, 200), {"type": "pointerUp"}]
            parameters = {"pointerType": "touch"}
            sources.append({"type": "pointer", "id": f"finger{finger}", "parameters": parameters, "actions": actions})
        self.call("POST", f"{self.session}/actions", {"actions": sources})

    def check_keyboard_access(self) -> None:
        """Checks that all visible controls are reached by Tab and have a name."""
        for _ in range(70):
            self.press("\ue004")  # Tab
            self.run("document.activeElement.dataset.reached = true")
        unreachable = self.run(UNREACHABLE)
        assert not unreachable, f"not reached by keyboard, or without a name: {unreachable}"

    def log(self, kind: str) -> list[dict]:
        return self.call("POST", f"{self.session}/se/log", {"type": kind})

    def screenshot(self, folder: Path | None, name: str) -> None:
        """Writes a screenshot if there is a folder for them."""
        if folder:
            png = self.call("GET", f"{self.session}/screenshot")
            (folder / f"{name}.png").write_bytes(base64.b64decode(png))

    def size(self, width: int, height: int) -> None:
        self.command("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def theme(self, name: str) -> None:
        self.command("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": name}])

    def close(self) -> None:
        self.call("DELETE", self.session)
        self.driver.terminate()
        self.driver.wait()


def check_moves(browser: Browser) -> None:
    """Checks that keys, mouse buttons and sliders move the camera in the right direction only."""
    browser.run("document.getElementById('marks').focus()")
    state = "return [camera.at, camera.right, camera.up, camera.back, camera.away, camera.fov]"
    dot = lambda a, b: sum(x * y for x, y in zip(a, b))

    def step_of(act) -> tuple[list[float], list, list]:
        """How far an action moves the camera to the right, up and back; the camera's state before and after."""
        browser.wait_until_sharp()
        before = browser.run(state)
        act()
        browser.wait_until_sharp()
        after = browser.run(state)
        step = [a - b for a, b in zip(after[0], before[0])]
        return [dot(step, axis) for axis in before[1:4]], before, after

    def hold(key: str) -> None:
        for kind in ("keyDown", "keyUp"):
            actions = [{"type": "key", "id": "keys", "actions": [{"type": kind, "value": key}]}]
            browser.call("POST", f"{browser.session}/actions", {"actions": actions})
            time.sleep(0.3)

    for key, axis, sign in [("w", 2, -1), ("a", 0, -1), ("d", 0, 1), ("e", 1, 1), ("q", 1, -1)]:
        step, before, after = step_of(lambda: hold(key))
        others = [abs(step[i]) for i in range(3) if i != axis]
        assert step[axis] * sign > 0 and max(others) < 1e-6, f"{key} moves by {step}"
        assert before[3] == after[3], f"{key} turns"
    drag = lambda button: browser.mouse(
        {"type": "pointerMove", "duration": 0, "origin": "viewport", "x": 440, "y": 380},
        {"type": "pointerDown", "button": button},
        {"type": "pointerMove", "duration": 0, "origin": "pointer", "x": 60, "y": 0},
        {"type": "pointerUp", "button": button},
    )
    # Dragging the scene to the right moves the camera to the left.
    step, before, after = step_of(lambda: drag(2))
    assert step[0] < 0 and abs(step[1]) < 1e-6 and before[3] == after[3], f"the right button moves by {step}"
    step, before, after = step_of(lambda: drag(0))
    assert before[3] != after[3] and step[0] < 0, f"the left button moves by {step}"
    step, before, after = step_of(lambda: browser.press("+"))
    assert step[2] < 0 and after[4] < before[4], f"+ moves by {step}"
    step, before, after = step_of(lambda: browser.press("-"))
    assert step[2] > 0 and after[4] > before[4], f"- moves by {step}"
    # Arrow keys act like dragging; with Shift they pan.
    click = "document.querySelector(arguments[0]).click()"
    right = "\ue014"
    for mode in ("look", "pan", "orbit"):
        browser.run(click, f"input[value={mode}]")
        browser.run("document.getElementById('marks').focus()")
        step, before, after = step_of(lambda: browser.press(right))
        turns, moves = before[3] != after[3], max(map(abs, step)) > 1e-6
        assert (turns, moves) == (mode != "pan", mode != "look"), f"an arrow key in mode {mode}: {turns}, {moves}"
        assert mode != "look" or dot(after[3], before[1]) < 0, "the right arrow looks to the left"
        assert mode != "pan" or step[0] > 0, f"the right arrow pans by {step}"
    keys = [{"type": kind, "value": key} for kind, key in [("keyDown", "\ue008"), ("keyDown", right), ("keyUp", right), ("keyUp", "\ue008")]]
    shift = {"actions": [{"type": "key", "id": "keys", "actions": keys}]}
    step, before, after = step_of(lambda: browser.call("POST", f"{browser.session}/actions", shift))
    assert step[0] > 0 and before[3] == after[3], f"Shift with an arrow moves by {step}"
    # Keys move the camera wherever the focus is, except for keys that the focused control uses.
    for there, keys, is_used in [("#loop", "+", True), ("#loop", right, True), ("#fov", "+", True), ("#fov", right, False),
                                 ("input[value=orbit]", "+", True), ("#left", "+", False)]:
        browser.run("document.querySelector(arguments[0]).focus()", there)
        at = browser.run("return camera.at")
        browser.press(keys)
        browser.wait_until_sharp()
        assert (browser.run("return camera.at") != at) == is_used, f"{keys!r} at {there}"
    slide = "const slider = document.getElementById(arguments[0]); slider.value = arguments[1];"
    slide += "for (const kind of ['input', 'change']) slider.dispatchEvent(new Event(kind, { bubbles: true }));"
    browser.run(slide, "fov", 30)
    assert browser.run(state)[5] == 30, "the field of view does not change"
    browser.wait_until_sharp()
    size = "return Number(document.getElementById('stage').dataset.size.split('x')[0])"
    full = browser.run(size)
    options = browser.run("return Array.from(document.getElementById('sharpness').options, (it) => it.value)")
    browser.choose("sharpness", min(options, key=float))
    assert browser.run(size) == int(full * float(min(options, key=float))), f"{browser.run(size)} px of {full}"
    browser.choose("sharpness", "1")
    browser.run("document.getElementById('marks').focus()")
    browser.press("[")
    browser.wait_until_sharp()
    assert browser.run("return view"), "[ goes to no camera"


def check(browser: Browser, url: str, densify: str, run: str, rendered: Path, folder: Path | None) -> None:
    browser.size(1280, 800)
    browser.theme("dark")
    browser.open(url)
    browser.wait_until_sharp()
    # The first time, the page opens with its help; Enter closes it.
    assert browser.run("return document.getElementById('guide').open"), "the help is not open at first"
    browser.screenshot(folder, "first")
    browser.press("\ue007")
    assert not browser.run("return document.getElementById('guide').open"), "Enter does not close the help"

    browser.choose("view", "test:0")
    browser.screenshot(folder, "test-camera")
    # Leaving a photograph's camera keeps the picture, with more around it.
    browser.run(MIDDLE_PSNR)
    browser.run("orbit(0, 0)")
    browser.wait_until_sharp()
    psnr = browser.run(MIDDLE_PSNR)
    assert psnr >= 38, f"the picture has a PSNR of {psnr:.1f} dB to that before leaving the camera"
    browser.choose("view", "test:0")
    browser.choose("left", "photograph:0")
    browser.choose("right", "render:0")
    # Photograph and render are shown at the photograph's size.
    expected = browser.run("const { width, height } = scene.views.test[0]; return `${width}x${height}`")
    found = browser.run("return document.getElementById('stage').dataset.size")
    assert found == expected, f"{found} instead of {expected}"
    # The picture is that of `densify render`.
    name = Path(browser.run("return scene.views.test[0].name")).with_suffix(".png")
    png = base64.b64encode((rendered / "pictures" / name).read_bytes()).decode()
    psnr = browser.run_async(PSNR, f"data:image/png;base64,{png}")
    assert psnr >= 38, f"the picture has a PSNR of {psnr:.1f} dB to that of densify render"
    before = browser.run(PROBE)
    browser.run("document.getElementById('divider').focus()")
    browser.press("\ue011")  # Home
    after = browser.run(PROBE)
    assert before["light"] != after["light"], "the border does not move"
    assert browser.run("return document.getElementById('divider').getAttribute('aria-valuenow')") == "0"
    browser.press(*["\ue014"] * 20)  # Right
    browser.screenshot(folder, "compare")
    browser.choose("left", "difference:0")
    assert browser.run("return document.getElementById('mean').textContent").startswith("Difference (FLIP): 0.")
    browser.screenshot(folder, "difference")
    browser.choose("right", "")
    browser.theme("light")
    bare = browser.run(MARK_PIXELS)
    browser.run("document.getElementById('frusta').click()")
    cameras = browser.run(MARK_PIXELS)
    browser.run("document.getElementById('points').click()")
    assert bare == 0 < cameras < browser.run(MARK_PIXELS), "cameras or points are not drawn"
    browser.screenshot(folder, "marks")
    browser.run("document.getElementById('points').click()")
    for kind in browser.run("return scene.kinds.map(({ kind }) => kind)"):
        browser.choose("left", f"{kind}:0")
        assert browser.run(PROBE)["spread"] > 4, f"{kind} is empty"
    browser.screenshot(folder, "rows")
    browser.choose("left", "render:0")

    # Turning: all pictures differ, and none is empty.
    seen: set[str] = set()
    middle = {"type": "pointerMove", "duration": 0, "origin": "viewport", "x": 440, "y": 380}
    browser.mouse(middle, {"type": "pointerDown", "button": 0})
    for step in range(STEPS):
        count = browser.run("return Number(document.getElementById('stage').dataset.pictures)")
        browser.mouse({"type": "pointerMove", "duration": 0, "origin": "pointer", "x": 11, "y": 3 if step % 2 else -2})
        browser.wait_for(f"Number(document.getElementById('stage').dataset.pictures) > {count}", f"no picture at step {step}")
        found = browser.run(PROBE)
        assert found["spread"] > 4, f"picture {step} is empty"
        seen.add(found["light"])
    assert len(seen) == STEPS, f"{STEPS} steps gave {len(seen)} pictures"
    # The scene stops turning when the button is released, here over the panel.
    browser.mouse({"type": "pointerUp", "button": 0})
    browser.wait_until_sharp()
    browser.screenshot(folder, "anywhere")
    before = browser.run("return version")
    browser.mouse(middle)
    assert browser.run("return version") == before, "the scene still turns after the button is released"
    # A click on a camera's mark goes to that camera.
    x, y, found = browser.run(CAMERA_MARK)
    place = {"type": "pointerMove", "duration": 0, "origin": "viewport", "x": x, "y": y}
    browser.mouse(place, {"type": "pointerDown", "button": 0}, {"type": "pointerUp", "button": 0})
    assert found and browser.run("return view") == found, f"a click does not go to {found}"
    browser.wait_until_sharp()
    # The wheel moves the camera closer; pictures are smaller while it moves than at rest.
    watch = "window.sizes = []; const note = () => sizes.push(Number(stage.dataset.size.split('x')[0]));"
    browser.run(watch + "coarse = 0.4; new MutationObserver(note).observe(stage, { attributeFilter: ['data-size'] });")
    before = browser.run("return camera.away")
    wheel = {"type": "scroll", "x": 440, "y": 380, "deltaX": 0, "deltaY": -300, "duration": 0}
    browser.call("POST", f"{browser.session}/actions", {"actions": [{"type": "wheel", "id": "wheel", "actions": [wheel]}]})
    assert browser.run("return camera.away") < 0.9 * before, "the wheel does not move closer"
    browser.wait_until_sharp()
    sizes = browser.run("return sizes")
    assert sizes[0] < 0.6 * sizes[-1], f"widths of pictures while moving: {sizes} px"
    pace = "const { rate, rested } = document.getElementById('stage').dataset; return [rate, rested]"
    # Flying by keyboard.
    keys = lambda kind: [{"type": "key", "id": "keys", "actions": [{"type": kind, "value": "s"}]}]
    browser.run("document.getElementById('marks').focus()")
    before = browser.run("return [...camera.at]")
    browser.call("POST", f"{browser.session}/actions", {"actions": keys("keyDown")})
    time.sleep(1.5)
    browser.call("POST", f"{browser.session}/actions", {"actions": keys("keyUp")})
    browser.wait_until_sharp()
    assert browser.run("return dot(add(camera.at, arguments[0], -1), camera.back)", before) > 0, "S does not fly back"
    rate, rested = browser.run(pace)
    print(f"{rate} pictures per second moving; sharp {rested} ms after the last change")
    # Spreading two fingers moves the camera closer.
    before = browser.run("return camera.away")
    browser.pinch((400, 300), (480, 300), (300, 300), (580, 300))
    after = browser.run("return camera.away")
    assert after < 0.9 * before, f"spreading two fingers changes the distance from {before} to {after}"
    browser.wait_until_sharp()
    check_moves(browser)
    browser.check_keyboard_access()
    browser.run("document.getElementById('marks').focus()")
    browser.press("k", "r", "]", "k")
    assert not browser.run("return document.getElementById('save').disabled"), "there is no camera path to save"
    assert browser.run("return keyframes.length") == 2
    # densify renders the camera path that the page saves.
    keep = "URL.createObjectURL = (blob) => { window.made = blob; return 'data:,'; };"
    keep += "HTMLAnchorElement.prototype.click = function () { if (this.download) made.text().then((it) => { window.saved = it; }); };"
    browser.run(keep + "document.getElementById('save').click()")
    browser.wait_for("window.saved", "no camera path is saved")
    path = rendered / "camera_path.json"
    path.write_text(browser.run("return saved"))
    fly = lambda to, *more: subprocess.run(
        [densify, "render", run, "--path", path, *more, "-o", rendered / to, "--backend", "cpu"], check=True, capture_output=True
    )
    # Two seconds between the two cameras, at 30 pictures per second.
    fly("flight", "--size", "16x12")
    frames = {it.read_bytes() for it in (rendered / "flight").rglob("*.png")}
    assert len(frames) == 60, f"{len(frames)} pictures of the flight"
    # The page's picture half-way along the path is that of densify.
    fly("thirds", "--frames", "3")
    browser.run("setOnPath(0.5); view = null; changed()")
    browser.wait_until_sharp()
    png = base64.b64encode((rendered / "thirds" / "frame_00001.png").read_bytes()).decode()
    psnr = browser.run_async(PSNR.replace("shown[1]", "shown[0]"), f"data:image/png;base64,{png}")
    assert psnr >= 36, f"half-way along the path, the page has a PSNR of {psnr:.1f} dB to densify"
    browser.run("document.getElementById('remove').click()")
    assert browser.run("return keyframes.length") == 1, "the last camera is not removed"

    # A narrow screen.
    browser.size(360, 740)
    browser.wait_until_sharp()
    for element in ["html", "#panel"]:
        width = browser.run("return document.querySelector(arguments[0]).scrollWidth", element)
        assert width <= 360, f"{element} is {width} px wide"
    assert browser.run("return area()[0]") > 340, "the panel leaves no room for the picture"
    browser.screenshot(folder, "phone")
    browser.run("document.getElementById('help').click()")
    width = browser.run("return document.getElementById('guide').scrollWidth")
    assert width <= 360, f"the help is {width} px wide"
    below = browser.run("const it = document.getElementById('guide'); return [it.scrollHeight - it.clientHeight, it.scrollTop]")
    assert below[0] > 0 and below[1] == 0, f"{below[0]} px of the help are out of view, and it opens {below[1]} px below its title"
    browser.screenshot(folder, "phone-help")
    browser.theme("dark")
    browser.run("document.getElementById('guide').close()")
    browser.run("document.getElementById('fold').click()")
    browser.wait_until_sharp()
    browser.screenshot(folder, "phone-dark")
    # A phone in landscape has the panel beside the picture.
    browser.run("document.getElementById('fold').click()")
    browser.size(740, 360)
    browser.wait_until_sharp()
    width, height = browser.run("return area()")
    assert width >= 400 and height >= 350, f"the picture is {width}x{height}"
    assert browser.run("return document.getElementById('panel').clientWidth") > 200, "there is no panel"
    browser.screenshot(folder, "phone-landscape")

    check_logs(browser, url)


def check_slow_network(browser: Browser, url: str) -> None:
    """Checks that a slow network hardly lowers the number and size of the pictures that the page shows per second."""

    def turned() -> tuple[float, float]:
        found = browser.run_async(TURN, 3)
        browser.wait_until_sharp()
        later = found["widths"][len(found["widths"]) // 2:]
        return found["rate"], sum(later) / len(later)

    browser.size(1280, 800)
    browser.open(url)
    browser.wait_until_sharp()
    # Latency, which does not depend on the number of pixels, does not make pictures smaller.
    for rendering, total, latency, is_larger in [(15, 20, 2, True), (80, 90, 2, False), (15, 115, 99, True), (15, 500, 99, True),
                                           (80, 180, 99, False)]:
        found = browser.run(COARSE_SIZE, rendering, total, latency)
        assert (found > 0.5) == is_larger, f"{rendering} ms to render, {total} ms in total, latency {latency} ms: {found}"
    browser.open(url)
    browser.wait_until_sharp()
    rate, width = turned()
    browser.run(DELAY, 80)
    browser.run("changed()")
    browser.wait_for("latency >= 80", "the page does not notice the latency")
    slow_rate, slow_width = turned()
    print(f"{rate:.1f} pictures/s, {width:.0f} px wide; with a latency of 80 ms {slow_rate:.1f}, {slow_width:.0f} px wide")
    assert slow_width >= width / 2, "over a slow network, pictures are too small"
    assert slow_rate >= 0.4 * rate, "over a slow network, pictures are too rare"
    assert browser.run("return atOnce") > 1, "over a slow network, the page waits for each picture before it requests the next"


def check_two_runs(browser: Browser, url: str, folder: Path | None) -> None:
    """Checks the page of two runs, which shows both from one camera with a border between them."""

    def halves() -> list[str]:
        lights = []
        for share in (0, 1):
            browser.run("setBorder(arguments[0])", share)
            lights.append(browser.run(PROBE)["light"])
        return lights

    browser.size(1280, 800)
    browser.theme("light")
    browser.open(url)
    browser.wait_until_sharp()
    if browser.run("return document.getElementById('guide').open"):
        browser.press("\ue007")  # Enter
    names = browser.run("return scene.models.map(({ name }) => name)")
    tags = browser.run("return ['left-name', 'right-name'].map((id) => document.getElementById(id).textContent)")
    assert len(names) == 2 and all(name in tag for name, tag in zip(names, tags)), f"{names}: {tags}"
    before = halves()
    assert before[0] != before[1], "both sides show the same model"
    # Both sides turn together.
    browser.run("document.getElementById('marks').focus()")
    browser.press("\ue012", "\ue012")  # Left
    browser.wait_until_sharp()
    after = halves()
    assert before[0] != after[0] and before[1] != after[1], "one side does not turn"
    # The border follows the mouse until the button is released, here beyond the picture's edge.
    x = browser.run("setBorder(0.5); return Math.round(area()[0] / 2)")
    move = lambda x: {"type": "pointerMove", "duration": 0, "origin": "viewport", "x": x, "y": 400}
    browser.mouse(move(x), {"type": "pointerDown", "button": 0})
    browser.mouse(move(x - 100))
    browser.mouse(move(x + 700))
    browser.mouse({"type": "pointerUp", "button": 0})
    assert browser.run("return border") == 1, "the border does not follow the mouse"
    browser.mouse(move(x))
    assert browser.run("return border") == 1, "the border follows the mouse after the button is released"
    browser.run("setBorder(0.5)")
    browser.screenshot(folder, "two")
    browser.size(360, 740)
    browser.wait_until_sharp()
    overlaps = browser.run(OVERLAPS, ["left-name", "right-name", "fold", "status"])
    assert not overlaps, f"these overlap: {overlaps}"
    browser.screenshot(folder, "two-phone")
    check_logs(browser, url)


def check_logs(browser: Browser, url: str) -> None:
    """Checks that the log has no errors or warnings, and that all requests went to the page's server."""
    severe = [entry["message"] for entry in browser.log("browser") if entry["level"] in ("SEVERE", "WARNING")]
    assert not severe, "\n".join(severe)
    events = [json.loads(entry["message"])["message"] for entry in browser.log("performance")]
    urls = {event["params"]["request"]["url"] for event in events if event["method"] == "Network.requestWillBeSent"}
    assert f"{url}frame" in urls, "the log has no request for a picture"
    foreign = [it for it in urls if not it.startswith((url, "data:", "blob:" + url.rstrip("/")))]
    assert not foreign, f"requests to other servers: {foreign}"


@contextmanager
def served(densify: str, *shown: str) -> Iterator[tuple[Browser, str]]:
    """Serves a page; yields a browser and the page's address."""
    command = [densify, "view", *shown, "--port", "0", "--backend", "cpu"]
    program = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert program.stdout
        line = next(line for line in program.stdout if line.startswith("page "))
        browser = Browser()
        try:
            yield browser, line.split()[1]
        finally:
            browser.close()
        program.send_signal(signal.SIGINT)
        assert program.wait(PATIENCE) == 0, "densify view does not end cleanly on Ctrl-C"
    finally:
        program.kill()


def main(densify: str, run: str, other: str, folder: str | None = None) -> None:
    screenshots = Path(folder) if folder else None
    if screenshots:
        screenshots.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as rendered:
        command = [densify, "render", run, "-o", f"{rendered}/pictures", "--backend", "cpu"]
        subprocess.run(command, check=True, capture_output=True)
        with served(densify, run) as (browser, url):
            check(browser, url, densify, run, Path(rendered), screenshots)
            check_slow_network(browser, url)
    with served(densify, run, other) as (browser, url):
        check_two_runs(browser, url, screenshots)
    print("the page shows a test camera like densify render, compares, turns, flies, fits 360 px, copes with a slow network, and "
          "sends no requests elsewhere")


if __name__ == "__main__":
    main(*sys.argv[1:])
