"""Drives the page of `densify view` in a real browser: Chromium without a window, through chromedriver.

    python view.py DENSIFY RUN OTHER [FOLDER FOR SCREENSHOTS]          needs chromium and chromium-driver

RUN and OTHER are of one scene, and RUN must hold views out. WebDriver is JSON over HTTP, for which Python's own
library is enough.
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
# A small picture of what the stage shows: enough to tell pictures apart, and from empty ones.
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
# Between the bytes of two pictures of one size.
DECIBELS = """
const decibels = (a, b) => {
  const sum = a.reduce((sum, x, i) => sum + (x - b[i]) ** 2, 0);
  return 10 * Math.log10(255 ** 2 / Math.max(sum / (a.length * 3 / 4), 1e-9));
};
"""
# Decibels between the right one of two pictures and a PNG, of one size.
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
# Decibels between the middle of the stage now and at the last call.
MIDDLE = DECIBELS + """
const { width, height } = picture, side = Math.round(height / 3);
const copy = document.createElement("canvas"), out = copy.getContext("2d", { willReadFrequently: true });
[copy.width, copy.height] = [side, side];
out.drawImage(picture, Math.round((side - width) / 2), Math.round((side - height) / 2));
const { data } = out.getImageData(0, 0, side, side), before = window.middle ?? data;
window.middle = data;
return decibels(data, before);
"""
# Pixels of the marks over the picture.
MARKED = """
const copy = document.createElement("canvas"), out = copy.getContext("2d", { willReadFrequently: true });
[copy.width, copy.height] = [marks.width, marks.height];
out.drawImage(marks, 0, 0);
const { data } = out.getImageData(0, 0, copy.width, copy.height);
return data.filter((value, i) => i % 4 === 3 && value).length;
"""
# A camera that is drawn: where, and which one a click there goes to.
DRAWN = """
const places = allViews().map(({ split, number }) => projector()(frustum(scene.views[split][number])[0]));
const [width, height] = area();
const [x, y] = places.find(([x, y, z]) => z > 0 && x > 20 && y > 60 && x < width - 120 && y < height - 60).map(Math.round);
return [x, y, cameraAt(x, y)];
"""
# What the keyboard cannot reach, or has no name, of what is seen.
UNREACHED = """
const seen = [...document.querySelectorAll("button, select, input, summary, [tabindex]")]
  .filter((it) => it.offsetParent !== null && !it.disabled && (it.type !== "radio" || it.checked));
const name = (it) => it.ariaLabel || it.labels?.[0]?.textContent || it.textContent;
return seen.filter((it) => !it.dataset.reached || !name(it).trim()).map((it) => it.id || it.outerHTML);
"""
# Which of these parts of the page lie over each other.
OVERLAPS = """
const boxes = arguments[0].map((id) => [id, document.getElementById(id).getBoundingClientRect()]);
const crosses = (a, b) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;
return boxes.flatMap(([id, box], i) => boxes.slice(i + 1).filter(([, other]) => crosses(box, other)).map(([other]) => `${id} and ${other}`));
"""
# Turns the scene with every frame of the screen, for some seconds; then says how many pictures were shown in a second,
# and their widths.
TURN = """
const done = arguments[arguments.length - 1], stage = document.getElementById("stage"), begun = performance.now();
const pictures = () => Number(stage.dataset.pictures), sides = [], before = pictures();
let last = before;
const turn = (now) => {
  if (now - begun > 1000 * arguments[0]) {
    const rate = (pictures() - before) / (performance.now() - begun) * 1000;
    return done({ rate, said: Number(stage.dataset.rate), sides });
  }
  orbit(0.012, 0.002 * Math.sin(now / 700));
  if (pictures() !== last) {
    last = pictures();
    sides.push(Number(stage.dataset.size.split("x")[0]));
  }
  requestAnimationFrame(turn);
};
requestAnimationFrame(turn);
"""
# How large a coarse picture is, of 1, after one that was half as large: by what it took to make and to come here, of
# 1000 bytes that take a microsecond each, and what a reply takes alone.
PACED = """
const [milliseconds, took, alone] = arguments;
[latency, perByte] = [alone, 1e-3];
pace([{ bitmap: { width: 1, height: 1 }, bytes: 1000, milliseconds, held: milliseconds, took }], performance.now() - took, true, 0.5);
return coarse;
"""
# Every reply comes later by so many milliseconds, as over a network; also counts the requests that are under way at once.
FAR = """
const near = window.fetch;
window.fetch = async (...request) => {
  window.atOnce = Math.max(window.atOnce ?? 0, underway);
  const answer = await near(...request);
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

    def wait(self, script: str, *arguments: object) -> object:
        """Runs a script that calls its last argument when it is done."""
        return self.call("POST", f"{self.session}/execute/async", {"script": script, "args": list(arguments)})

    def command(self, name: str, **parameters: object) -> None:
        """A command of the DevTools."""
        self.call("POST", f"{self.session}/goog/cdp/execute", {"cmd": name, "params": parameters})

    def until(self, condition: str, what: str) -> None:
        end = time.monotonic() + PATIENCE
        while not self.run(f"return Boolean({condition})"):
            assert time.monotonic() < end, f"{what}: {self.run('return document.body.innerText')}"
            time.sleep(0.02)

    def is_sharp(self) -> None:
        self.until("document.getElementById('stage').dataset.state === 'sharp'", "no sharp picture")

    def choose(self, name: str, value: str) -> None:
        """Chooses from a list, as a hand does."""
        script = "const list = document.getElementById(arguments[0]); list.value = arguments[1];"
        script += "list.dispatchEvent(new Event('change', { bubbles: true })); return list.value;"
        assert self.run(script, name, value) == value, f"{name} has no {value}"
        self.is_sharp()

    def press(self, *names: str) -> None:
        actions = [{"type": kind, "value": name} for name in names for kind in ("keyDown", "keyUp")]
        self.call("POST", f"{self.session}/actions", {"actions": [{"type": "key", "id": "keys", "actions": actions}]})

    def hand(self, *actions: dict) -> None:
        pointer = {"type": "pointer", "id": "hand", "parameters": {"pointerType": "mouse"}, "actions": list(actions)}
        self.call("POST", f"{self.session}/actions", {"actions": [pointer]})

    def pinch(self, *places: tuple[int, int]) -> None:
        """Two fingers: their places, one of each in turn, and where each goes."""
        sources = []
        for finger, (at, to) in enumerate([(places[0], places[2]), (places[1], places[3])]):
            move = lambda place, duration: {"type": "pointerMove", "duration": duration, "x": place[0], "y": place[1]}
            actions = [move(at, 0), {"type": "pointerDown"}, move(to, 200), {"type": "pointerUp"}]
            parameters = {"pointerType": "touch"}
            sources.append({"type": "pointer", "id": f"finger{finger}", "parameters": parameters, "actions": actions})
        self.call("POST", f"{self.session}/actions", {"actions": sources})

    def is_reached_by_key(self) -> None:
        """Everything that is seen is reached by key, and has a name."""
        for _ in range(70):
            self.press("\ue004")  # Tab
            self.run("document.activeElement.dataset.reached = true")
        unreached = self.run(UNREACHED)
        assert not unreached, f"not reached by key, or without a name: {unreached}"

    def log(self, kind: str) -> list[dict]:
        return self.call("POST", f"{self.session}/se/log", {"type": kind})

    def keep(self, folder: Path | None, name: str) -> None:
        """Writes a screenshot, where there is a folder for them."""
        if folder:
            self.picture(folder / f"{name}.png")

    def size(self, width: int, height: int) -> None:
        self.command("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def theme(self, name: str) -> None:
        self.command("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": name}])

    def picture(self, path: Path) -> None:
        path.write_bytes(base64.b64decode(self.call("GET", f"{self.session}/screenshot")))

    def close(self) -> None:
        self.call("DELETE", self.session)
        self.driver.terminate()
        self.driver.wait()


def moves(browser: Browser) -> None:
    """Every other way to move, each in the right direction and no other."""
    browser.run("document.getElementById('marks').focus()")
    state = "return [camera.at, camera.right, camera.up, camera.back, camera.away, camera.fov]"
    dot = lambda a, b: sum(x * y for x, y in zip(a, b))

    def went(act) -> tuple[list[float], list, list]:
        """How far the camera went to the right, up and back."""
        browser.is_sharp()
        before = browser.run(state)
        act()
        browser.is_sharp()
        after = browser.run(state)
        step = [a - b for a, b in zip(after[0], before[0])]
        return [dot(step, axis) for axis in before[1:4]], before, after

    def held(key: str) -> None:
        for kind in ("keyDown", "keyUp"):
            actions = [{"type": "key", "id": "keys", "actions": [{"type": kind, "value": key}]}]
            browser.call("POST", f"{browser.session}/actions", {"actions": actions})
            time.sleep(0.3)

    for key, axis, sign in [("w", 2, -1), ("a", 0, -1), ("d", 0, 1), ("e", 1, 1), ("q", 1, -1)]:
        step, before, after = went(lambda: held(key))
        others = [abs(step[i]) for i in range(3) if i != axis]
        assert step[axis] * sign > 0 and max(others) < 1e-6, f"{key} goes {step}"
        assert before[3] == after[3], f"{key} turns"
    drag = lambda button: browser.hand(
        {"type": "pointerMove", "duration": 0, "origin": "viewport", "x": 440, "y": 380},
        {"type": "pointerDown", "button": button},
        {"type": "pointerMove", "duration": 0, "origin": "pointer", "x": 60, "y": 0},
        {"type": "pointerUp", "button": button},
    )
    # What is shifted to the right is seen from farther left.
    step, before, after = went(lambda: drag(2))
    assert step[0] < 0 and abs(step[1]) < 1e-6 and before[3] == after[3], f"the right button goes {step}"
    step, before, after = went(lambda: drag(0))
    assert before[3] != after[3] and step[0] < 0, f"the left button goes {step}"
    step, before, after = went(lambda: browser.press("+"))
    assert step[2] < 0 and after[4] < before[4], f"+ goes {step}"
    step, before, after = went(lambda: browser.press("-"))
    assert step[2] > 0 and after[4] > before[4], f"- goes {step}"
    # Arrow keys do what dragging does, and with Shift they shift.
    click = "document.querySelector(arguments[0]).click()"
    right = "\ue014"
    for mode in ("look", "pan", "orbit"):
        browser.run(click, f"input[value={mode}]")
        browser.run("document.getElementById('marks').focus()")
        step, before, after = went(lambda: browser.press(right))
        turns, shifts = before[3] != after[3], max(map(abs, step)) > 1e-6
        assert (turns, shifts) == (mode != "pan", mode != "look"), f"an arrow key, to {mode}: {turns}, {shifts}"
        # To the right is to the right.
        assert mode != "look" or dot(after[3], before[1]) < 0, "an arrow to the right turns the head to the left"
        assert mode != "pan" or step[0] > 0, f"an arrow to the right shifts by {step}"
    keys = [{"type": kind, "value": key} for kind, key in [("keyDown", "\ue008"), ("keyDown", right), ("keyUp", right), ("keyUp", "\ue008")]]
    shift = {"actions": [{"type": "key", "id": "keys", "actions": keys}]}
    step, before, after = went(lambda: browser.call("POST", f"{browser.session}/actions", shift))
    assert step[0] > 0 and before[3] == after[3], f"Shift with an arrow goes {step}"
    # Keys are the scene's wherever the focus is, but for those that the control there needs.
    for there, keys, is_used in [("#loop", "+", True), ("#loop", right, True), ("#fov", "+", True), ("#fov", right, False),
                                 ("input[value=orbit]", "+", True), ("#left", "+", False)]:
        browser.run("document.querySelector(arguments[0]).focus()", there)
        at = browser.run("return camera.at")
        browser.press(keys)
        browser.is_sharp()
        assert (browser.run("return camera.at") != at) == is_used, f"{keys!r} at {there}"
    slide = "const slider = document.getElementById(arguments[0]); slider.value = arguments[1];"
    slide += "for (const kind of ['input', 'change']) slider.dispatchEvent(new Event(kind, { bubbles: true }));"
    browser.run(slide, "fov", 30)
    assert browser.run(state)[5] == 30, "the field of view stays"
    browser.is_sharp()
    size = "return Number(document.getElementById('stage').dataset.size.split('x')[0])"
    whole = browser.run(size)
    options = browser.run("return Array.from(document.getElementById('sharpness').options, (it) => it.value)")
    browser.choose("sharpness", min(options, key=float))
    assert browser.run(size) == int(whole * float(min(options, key=float))), f"{browser.run(size)} px of {whole}"
    browser.choose("sharpness", "1")
    browser.run("document.getElementById('marks').focus()")
    browser.press("[")
    browser.is_sharp()
    assert browser.run("return view"), "[ goes to no camera"


def check(browser: Browser, url: str, densify: str, run: str, rendered: Path, folder: Path | None) -> None:
    browser.size(1280, 800)
    browser.theme("dark")
    browser.open(url)
    browser.is_sharp()
    # The first time it says what is seen; the key that everything begins with closes that.
    assert browser.run("return document.getElementById('guide').open"), "no help at first"
    browser.keep(folder, "first")
    browser.press("\ue007")
    assert not browser.run("return document.getElementById('guide').open"), "Enter does not close the help"

    browser.choose("view", "test:0")
    browser.keep(folder, "test-camera")
    # Whoever leaves a photograph's camera sees the same, with more around it.
    browser.run(MIDDLE)
    browser.run("orbit(0, 0)")
    browser.is_sharp()
    near = browser.run(MIDDLE)
    assert near >= 38, f"the picture is {near:.1f} dB from that of the camera that was left"
    browser.choose("view", "test:0")
    browser.choose("left", "photograph:0")
    browser.choose("right", "render:0")
    # What the photograph's camera saw, and what is drawn there, at the photograph's own size.
    own = browser.run("const { width, height } = scene.views.test[0]; return `${width}x${height}`")
    found = browser.run("return document.getElementById('stage').dataset.size")
    assert found == own, f"{found} instead of {own}"
    # Pixel by pixel it is what `densify render` writes.
    name = Path(browser.run("return scene.views.test[0].name")).with_suffix(".png")
    png = base64.b64encode((rendered / "pictures" / name).read_bytes()).decode()
    near = browser.wait(PSNR, f"data:image/png;base64,{png}")
    assert near >= 38, f"the picture is {near:.1f} dB from that of densify render"
    before = browser.run(PROBE)
    browser.run("document.getElementById('divider').focus()")
    browser.press("\ue011")  # Home
    after = browser.run(PROBE)
    assert before["light"] != after["light"], "the border does not move"
    assert browser.run("return document.getElementById('divider').getAttribute('aria-valuenow')") == "0"
    browser.press(*["\ue014"] * 20)  # Right
    browser.keep(folder, "compare")
    browser.choose("left", "difference:0")
    assert browser.run("return document.getElementById('mean').textContent").startswith("Difference (FLIP): 0.")
    browser.keep(folder, "difference")
    browser.choose("right", "")
    browser.theme("light")
    bare = browser.run(MARKED)
    browser.run("document.getElementById('frusta').click()")
    cameras = browser.run(MARKED)
    browser.run("document.getElementById('points').click()")
    assert bare == 0 < cameras < browser.run(MARKED), "cameras or points are not drawn"
    browser.keep(folder, "marks")
    browser.run("document.getElementById('points').click()")
    for kind in browser.run("return scene.kinds.map(({ kind }) => kind)"):
        browser.choose("left", f"{kind}:0")
        assert browser.run(PROBE)["spread"] > 4, f"{kind} is empty"
    browser.keep(folder, "rows")
    browser.choose("left", "render:0")

    # Turning: every picture differs, and none is empty.
    seen: set[str] = set()
    middle = {"type": "pointerMove", "duration": 0, "origin": "viewport", "x": 440, "y": 380}
    browser.hand(middle, {"type": "pointerDown", "button": 0})
    for step in range(STEPS):
        count = browser.run("return Number(document.getElementById('stage').dataset.pictures)")
        browser.hand({"type": "pointerMove", "duration": 0, "origin": "pointer", "x": 11, "y": 3 if step % 2 else -2})
        browser.until(f"Number(document.getElementById('stage').dataset.pictures) > {count}", f"no picture at step {step}")
        found = browser.run(PROBE)
        assert found["spread"] > 4, f"picture {step} is empty"
        seen.add(found["light"])
    assert len(seen) == STEPS, f"{STEPS} steps gave {len(seen)} pictures"
    # Lifted over the panel, the hand turns no more.
    browser.hand({"type": "pointerUp", "button": 0})
    browser.is_sharp()
    browser.keep(folder, "anywhere")
    before = browser.run("return version")
    browser.hand(middle)
    assert browser.run("return version") == before, "who has let go still turns"
    # A click on a camera that is drawn goes there.
    x, y, found = browser.run(DRAWN)
    place = {"type": "pointerMove", "duration": 0, "origin": "viewport", "x": x, "y": y}
    browser.hand(place, {"type": "pointerDown", "button": 0}, {"type": "pointerUp", "button": 0})
    assert found and browser.run("return view") == found, f"no click goes to {found}"
    browser.is_sharp()
    # The wheel goes nearer; on the way pictures are smaller than at rest.
    watch = "window.sizes = []; const note = () => sizes.push(Number(stage.dataset.size.split('x')[0]));"
    browser.run(watch + "coarse = 0.4; new MutationObserver(note).observe(stage, { attributeFilter: ['data-size'] });")
    before = browser.run("return camera.away")
    wheel = {"type": "scroll", "x": 440, "y": 380, "deltaX": 0, "deltaY": -300, "duration": 0}
    browser.call("POST", f"{browser.session}/actions", {"actions": [{"type": "wheel", "id": "wheel", "actions": [wheel]}]})
    assert browser.run("return camera.away") < 0.9 * before, "the wheel does not go nearer"
    browser.is_sharp()
    sizes = browser.run("return sizes")
    assert sizes[0] < 0.6 * sizes[-1], f"pictures of {sizes} px on the way"
    pace = "const { rate, rested } = document.getElementById('stage').dataset; return [rate, rested]"
    # Flying by key, as fast as pictures come.
    keys = lambda kind: [{"type": "key", "id": "keys", "actions": [{"type": kind, "value": "s"}]}]
    browser.run("document.getElementById('marks').focus()")
    before = browser.run("return [...camera.at]")
    browser.call("POST", f"{browser.session}/actions", {"actions": keys("keyDown")})
    time.sleep(1.5)
    browser.call("POST", f"{browser.session}/actions", {"actions": keys("keyUp")})
    browser.is_sharp()
    assert browser.run("return dot(add(camera.at, arguments[0], -1), camera.back)", before) > 0, "S does not fly back"
    rate, rested = browser.run(pace)
    print(f"{rate} pictures per second moving; sharp {rested} ms after the last change")
    # Two fingers that part go nearer.
    before = browser.run("return camera.away")
    browser.pinch((400, 300), (480, 300), (300, 300), (580, 300))
    after = browser.run("return camera.away")
    assert after < 0.9 * before, f"fingers that part: from {before} to {after} away"
    browser.is_sharp()
    moves(browser)
    browser.is_reached_by_key()
    browser.run("document.getElementById('marks').focus()")
    browser.press("k", "r", "]", "k")
    assert not browser.run("return document.getElementById('save').disabled"), "no camera path to save"
    assert browser.run("return keys.length") == 2
    # What the page saves, densify flies along.
    keep = "URL.createObjectURL = (blob) => { window.made = blob; return 'data:,'; };"
    keep += "HTMLAnchorElement.prototype.click = function () { if (this.download) made.text().then((it) => { window.saved = it; }); };"
    browser.run(keep + "document.getElementById('save').click()")
    browser.until("window.saved", "no camera path is saved")
    path = rendered / "camera_path.json"
    path.write_text(browser.run("return saved"))
    fly = lambda to, *more: subprocess.run(
        [densify, "render", run, "--path", path, *more, "-o", rendered / to, "--backend", "cpu"], check=True, capture_output=True
    )
    # Two seconds from camera to camera, 30 pictures each.
    fly("flight", "--size", "16x12")
    frames = {it.read_bytes() for it in (rendered / "flight").rglob("*.png")}
    assert len(frames) == 60, f"{len(frames)} pictures of the flight"
    # Half-way the page is where the film is.
    fly("thirds", "--frames", "3")
    browser.run("setOnPath(0.5); view = null; changed()")
    browser.is_sharp()
    png = base64.b64encode((rendered / "thirds" / "frame_00001.png").read_bytes()).decode()
    near = browser.wait(PSNR.replace("shown[1]", "shown[0]"), f"data:image/png;base64,{png}")
    assert near >= 36, f"half-way along the path the page is {near:.1f} dB from the film"
    browser.run("document.getElementById('remove').click()")
    assert browser.run("return keys.length") == 1, "the last camera is not removed"

    # Where there is little room.
    browser.size(360, 740)
    browser.is_sharp()
    for element in ["html", "#panel"]:
        width = browser.run("return document.querySelector(arguments[0]).scrollWidth", element)
        assert width <= 360, f"{element} is {width} px wide"
    assert browser.run("return area()[0]") > 340, "the panel leaves the picture no room"
    browser.keep(folder, "phone")
    browser.run("document.getElementById('help').click()")
    width = browser.run("return document.getElementById('guide').scrollWidth")
    assert width <= 360, f"the help is {width} px wide"
    below = browser.run("const it = document.getElementById('guide'); return [it.scrollHeight - it.clientHeight, it.scrollTop]")
    assert below[0] > 0 and below[1] == 0, f"of the help {below[0]} px do not fit, and it opens {below[1]} px below its title"
    browser.keep(folder, "phone-help")
    browser.theme("dark")
    browser.run("document.getElementById('guide').close()")
    browser.run("document.getElementById('fold').click()")
    browser.is_sharp()
    browser.keep(folder, "phone-dark")
    # A phone on its side has its panel beside the picture.
    browser.run("document.getElementById('fold').click()")
    browser.size(740, 360)
    browser.is_sharp()
    width, height = browser.run("return area()")
    assert width >= 400 and height >= 350, f"the picture is {width}x{height}"
    assert browser.run("return document.getElementById('panel').clientWidth") > 200, "there is no panel"
    browser.keep(folder, "phone-on-its-side")

    is_clean(browser, url)


def check_from_afar(browser: Browser, url: str) -> None:
    """Over a slow network it moves as fluently, in pictures that are not much smaller."""

    def turned() -> tuple[float, float]:
        found = browser.wait(TURN, 3)
        browser.is_sharp()
        half = found["sides"][len(found["sides"]) // 2:]
        return found["rate"], sum(half) / len(half)

    browser.size(1280, 800)
    browser.open(url)
    browser.is_sharp()
    # What does not get shorter with fewer pixels does not make pictures smaller.
    for making, took, alone, is_larger in [(15, 20, 2, True), (80, 90, 2, False), (15, 115, 99, True), (15, 500, 99, True),
                                           (80, 180, 99, False)]:
        found = browser.run(PACED, making, took, alone)
        assert (found > 0.5) == is_larger, f"{making} ms to make, {took} ms until it is here, {alone} ms of them on its way: {found}"
    browser.open(url)
    browser.is_sharp()
    near, side = turned()
    browser.run(FAR, 80)
    browser.run("changed()")
    browser.until("latency >= 80", "it does not see how far away it is")
    far, smaller = turned()
    print(f"{near:.1f} pictures/s, {side:.0f} px wide; 80 ms away {far:.1f}, {smaller:.0f} px wide")
    assert smaller >= side / 2, f"pictures of {smaller:.0f} px from afar, {side:.0f} px from near"
    assert far >= 0.4 * near, f"{far:.1f} pictures/s from afar, {near:.1f} from near"
    assert browser.run("return atOnce") > 1, "from afar it waits for each picture before it asks for the next"


def check_two(browser: Browser, url: str, folder: Path | None) -> None:
    """Two runs, seen from one camera, with a border between them."""

    def halves() -> list[str]:
        lights = []
        for share in (0, 1):
            browser.run("setBorder(arguments[0])", share)
            lights.append(browser.run(PROBE)["light"])
        return lights

    browser.size(1280, 800)
    browser.theme("light")
    browser.open(url)
    browser.is_sharp()
    if browser.run("return document.getElementById('guide').open"):
        browser.press("\ue007")
    names = browser.run("return scene.models.map(({ name }) => name)")
    tags = browser.run("return ['left-name', 'right-name'].map((id) => document.getElementById(id).textContent)")
    assert len(names) == 2 and all(name in tag for name, tag in zip(names, tags)), f"{names}: {tags}"
    before = halves()
    assert before[0] != before[1], "both sides show one model"
    # Whoever turns one turns the other.
    browser.run("document.getElementById('marks').focus()")
    browser.press("\ue012", "\ue012")  # Left
    browser.is_sharp()
    after = halves()
    assert before[0] != after[0] and before[1] != after[1], "one side stands still"
    # By hand, in steps of their own, and lifted beyond the edge.
    x = browser.run("setBorder(0.5); return Math.round(area()[0] / 2)")
    move = lambda x: {"type": "pointerMove", "duration": 0, "origin": "viewport", "x": x, "y": 400}
    browser.hand(move(x), {"type": "pointerDown", "button": 0})
    browser.hand(move(x - 100))
    browser.hand(move(x + 700))
    browser.hand({"type": "pointerUp", "button": 0})
    assert browser.run("return border") == 1, "the border does not follow the hand"
    browser.hand(move(x))
    assert browser.run("return border") == 1, "the border follows a hand that has let go"
    browser.run("setBorder(0.5)")
    browser.keep(folder, "two")
    browser.size(360, 740)
    browser.is_sharp()
    over = browser.run(OVERLAPS, ["left-name", "right-name", "fold", "status"])
    assert not over, f"{over} lie over each other"
    browser.keep(folder, "two-phone")
    is_clean(browser, url)


def is_clean(browser: Browser, url: str) -> None:
    """Nothing was complained about, and nothing asked of others."""
    severe = [entry["message"] for entry in browser.log("browser") if entry["level"] in ("SEVERE", "WARNING")]
    assert not severe, "\n".join(severe)
    events = [json.loads(entry["message"])["message"] for entry in browser.log("performance")]
    urls = {event["params"]["request"]["url"] for event in events if event["method"] == "Network.requestWillBeSent"}
    assert f"{url}frame" in urls, "no request is known"
    strange = [it for it in urls if not it.startswith((url, "data:", "blob:" + url.rstrip("/")))]
    assert not strange, f"requests beyond the page: {strange}"


@contextmanager
def served(densify: str, *shown: str) -> Iterator[tuple[Browser, str]]:
    """A browser, and the address of a page that is served meanwhile."""
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
        assert program.wait(PATIENCE) == 0, "Ctrl-C does not end it well"
    finally:
        program.kill()


def main(densify: str, run: str, other: str, folder: str | None = None) -> None:
    kept = Path(folder) if folder else None
    if kept:
        kept.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as rendered:
        command = [densify, "render", run, "-o", f"{rendered}/pictures", "--backend", "cpu"]
        subprocess.run(command, check=True, capture_output=True)
        with served(densify, run) as (browser, url):
            check(browser, url, densify, run, Path(rendered), kept)
            check_from_afar(browser, url)
    with served(densify, run, other) as (browser, url):
        check_two(browser, url, kept)
    print("the page shows a test camera as densify render does, compares, turns, flies, fits 360 px, is fluent from afar, and "
          "asks nobody else")


if __name__ == "__main__":
    main(*sys.argv[1:])
