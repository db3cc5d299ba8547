// The page of densify view: requests and shows pictures, and moves the camera. One file without a build step; its
// parts, in order: vectors, the camera, requesting and showing pictures, marks, moving, the panel.
"use strict";

const byId = (id) => document.getElementById(id);
const stage = byId("stage"), picture = byId("picture"), marks = byId("marks");

// ---- Vectors. A camera's axes are right, up and back, as in camera paths.

const add = (a, b, s = 1) => a.map((x, i) => x + s * b[i]);
const scale = (a, s) => a.map((x) => x * s);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const length = (a) => Math.sqrt(dot(a, a));
const unit = (a) => scale(a, 1 / (length(a) || 1));
const radians = (degrees) => degrees * Math.PI / 180;
const clamp = (x, least, most) => Math.min(Math.max(x, least), most);

/** Rotates a vector about a unit axis. */
function turned(v, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle);
  return add(add(scale(v, c), cross(axis, v), s), axis, dot(axis, v) * (1 - c));
}

// ---- The camera.

let scene;
/** The camera: centre, axes, vertical field of view in degrees, and distance to the pivot of orbiting. */
const camera = { at: [0, 0, 0], right: [1, 0, 0], up: [0, 1, 0], back: [0, 0, 1], fov: 50, away: 1 };
/** The view whose camera is used, or null: { split, number }. */
let view = null;
/** Number of changes to the requested picture, and the time of the last one. */
let version = 0, changedAt = 0;

/** Sets the pose from the scene's description or a camera path. */
function setPose({ camera_to_world: m, fov }) {
  [camera.right, camera.up, camera.back] = [0, 1, 2].map((i) => unit([m[i], m[4 + i], m[8 + i]]));
  camera.at = [m[3], m[7], m[11]];
  camera.fov = fov;
}

/** The camera in the format of camera paths. */
function pose() {
  const { right: r, up: u, back: b, at } = camera;
  const m = [0, 1, 2].flatMap((i) => [r[i], u[i], b[i], at[i]]);
  return { camera_to_world: [...m, 0, 0, 0, 1], fov: camera.fov };
}

function changed() {
  version += 1;
  changedAt = performance.now();
  stage.dataset.state = "moving";
  wake();
}

/** Requests a new picture with the same camera, because the model has changed. */
function requestPicture() {
  version += 1;
  wake();
}

/** Leaves the camera of a view, to move freely; the scene keeps its size on the screen. */
function leaveView() {
  if (!view) return;
  const fitted = fit(shape(), area());
  const half = Math.tan(radians(camera.fov) / 2) * area()[1] / fitted[1];
  camera.fov = clamp(2 * Math.atan(half) * 180 / Math.PI, 10, 120);
  view = null;
  byId("view").value = "";
  showControls();
}

function turnAll(axis, angle) {
  for (const name of ["right", "up", "back"]) camera[name] = unit(turned(camera[name], axis, angle));
}

/** Orbits about the pivot: by `x` about the scene's vertical axis, by `y` about the camera's horizontal axis. */
function orbit(x, y) {
  leaveView();
  const pivot = add(camera.at, camera.back, -camera.away);
  turnAll(scene.up, -x);
  // Stop at the poles, beyond which left and right would swap.
  const height = Math.asin(clamp(dot(camera.back, scene.up), -1, 1));
  const target = clamp(height + y, -1.5, 1.5);
  if (Math.abs(height) < 1.5 || Math.abs(target) < Math.abs(height)) turnAll(camera.right, -(target - height));
  camera.at = add(pivot, camera.back, camera.away);
  changed();
}

/** Turns the camera in place. */
function look(x, y) {
  leaveView();
  const height = Math.asin(clamp(-dot(camera.back, scene.up), -1, 1));
  turnAll(scene.up, x);
  const target = clamp(height + y, -1.5, 1.5);
  if (Math.abs(height) < 1.5 || Math.abs(target) < Math.abs(height)) turnAll(camera.right, target - height);
  changed();
}

/** Shifts the scene by fractions of the picture's height. */
function pan(x, y) {
  leaveView();
  const reach = 2 * Math.tan(radians(camera.fov) / 2) * camera.away;
  camera.at = add(add(camera.at, camera.right, -x * reach), camera.up, y * reach);
  changed();
}

/** Moves towards the pivot (factor below 1) or away from it. */
function dolly(factor) {
  leaveView();
  const least = 0.02 * scene.radius;
  const away = clamp(camera.away * factor, least, 1e3 * scene.radius);
  // Close to the pivot, move through it.
  const step = away > least ? camera.away - away : 0.1 * least;
  camera.at = add(camera.at, camera.back, -step);
  camera.away = away;
  changed();
}

// ---- Requesting and showing pictures.

/** Identifier of this page: the server keeps only the newest request of each page and pane. */
const page = Array.from(crypto.getRandomValues(new Uint8Array(12)), (x) => x.toString(16).padStart(2, "0")).join("");
/** Time from the last change to the request for the sharp picture [ms]. */
const REST = 30;
/** Target time between pictures while moving [ms]. */
const PACE = 45;
/** The two shown pictures: bitmaps with their data. */
const shown = [null, null];
/** Size of coarse pictures relative to sharp ones, version of the last sharp picture, place of the border, what ends
 * a pause, and the latest times between pictures [ms]. */
let coarse = 0.5, complete = -1, border = 0.5, wakeUp = () => {}, paces = [];
/** Latency of a reply that needs no rendering, and time per byte of a reply [ms]. */
let latency = 0, perByte = 0;
/** Number of pending requests, number of all requests so far, and the number of the request whose picture is shown. */
let underway = 0, requests = 0, newest = 0;
/** The last request, and the minimum time from it to the next one [ms]. */
let last = { version: -1, isMoving: true, begun: 0 }, spacing = 0;
/** Time at which the last picture was shown [ms]. */
let shownAt = 0;

const wake = () => wakeUp();
/** Waits for a change, at most this long [ms]. */
const pause = (most) => new Promise((resolve) => {
  wakeUp = resolve;
  if (most < Infinity) setTimeout(resolve, most);
});
const sides = () => [choice(byId("left").value), choice(byId("right").value)];
const choice = (value) => value ? { kind: value.split(":")[0], model: Number(value.split(":")[1]) } : null;
const kindOf = (name) => scene.kinds.find((kind) => kind.kind === name);
const area = () => [stage.clientWidth, stage.clientHeight];

/** Width and height of the camera's picture. */
function shape() {
  if (!view) return area();
  const { width, height } = scene.views[view.split][view.number];
  return [width, height];
}

/** The largest size of this aspect ratio within an area. */
function fit([width, height], within) {
  const s = Math.min(within[0] / width, within[1] / height);
  return [width * s, height * s];
}

/** The size to request: this fraction of each side of the sharp picture. */
function wantedSize(part) {
  let [width, height] = fit(shape(), area()).map((side) => side * devicePixelRatio * byId("sharpness").value);
  const { side, pixels } = scene.limits;
  // Photographs are requested at their own size, as are renders compared with them: that is the evaluated size.
  if (sides().some((side) => side && kindOf(side.kind).needs_photograph)) {
    [width, height] = shape().map((own) => own * byId("sharpness").value);
  }
  const most = Math.min(1, side / width, side / height, Math.sqrt(pixels / (width * height)));
  return [width, height].map((wanted) => Math.max(1, Math.floor(wanted * most * part)));
}

async function ask(place, { kind, model }, isMoving, part) {
  const [width, height] = wantedSize(part);
  const from = view ? { view } : { camera: pose() };
  const begun = performance.now();
  const answer = await fetch("frame", {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify({ page, place, kind, model, width, height, moving: isMoving, ...from }),
  });
  // A newer request of this page has replaced this one.
  if (answer.status === 409) return null;
  if (!answer.ok) throw new Error(await answer.text());
  const number = (name) => answer.headers.has(name) ? Number(answer.headers.get(name)) : null;
  const numbers = (name) => answer.headers.get(name)?.split(" ").map(Number) ?? null;
  const blob = await answer.blob(), bitmap = await createImageBitmap(blob);
  return {
    bitmap, kind, model, bytes: blob.size,
    mean: number("X-Mean"), distance: number("X-Distance"), milliseconds: number("X-Milliseconds"),
    range: numbers("X-Range"), measured: numbers("X-Measured"), held: number("X-Held"), took: performance.now() - begun,
  };
}

/** Time until the next request [ms]; infinite if something has to happen first. */
function untilNext() {
  // A hidden page needs no pictures; a run in training should not render for it.
  if (document.hidden || complete === version || underway >= inFlight()) return Infinity;
  const now = performance.now(), rest = REST - (now - changedAt);
  const isNew = last.version !== version;
  // Without a change, only the sharp picture is missing, which waits until the camera rests.
  if (!isNew && (!last.isMoving || isFlying())) return Infinity;
  return Math.max(last.begun + spacing - now, isNew ? 0 : rest);
}

/** Maximum number of pending requests: over a slow network, several keep the renderer busy. */
const inFlight = () => clamp(1 + Math.round(latency / PACE), 1, 4);

/** Requests pictures while the page is open: coarse ones while something changes, then a sharp one. */
async function keepAsking() {
  for (;;) {
    const wait = untilNext();
    if (wait > 0) await pause(wait);
    else requestAndShow();
  }
}

/** Requests a picture of the current state and shows it. */
async function requestAndShow() {
  const begun = performance.now(), asked = version, request = ++requests;
  const isMoving = begun - changedAt < REST || isFlying(), part = isMoving ? coarse : 1;
  const [left, right] = sides();
  last = { version, isMoving, begun };
  underway += 1;
  try {
    const frames = await Promise.all([ask(0, left, isMoving, part), right && ask(1, right, isMoving, part)]);
    // A newer picture has replaced this one, on the server or during the transfer.
    const isLate = request < newest || !frames[0] || (right && !frames[1]);
    if (isLate) frames.forEach((frame) => frame?.bitmap.close());
    else show(frames, { begun, asked, request, isMoving, part });
  } catch (error) {
    const isGone = error instanceof TypeError;
    const gone = scene.live ? "Training has ended, or densify was stopped." : "densify view does not answer; start it again, and this page continues.";
    trouble(isGone ? gone : error.message);
    stage.dataset.state = "trouble";
    if (isGone) last.version = -1;
    else complete = asked;
    spacing = 1000;
  }
  underway -= 1;
  wake();
}

/** Shows the pictures of a request. */
function show(frames, { begun, asked, request, isMoving, part }) {
  newest = request;
  for (const [i, frame] of frames.entries()) {
    shown[i]?.bitmap.close();
    shown[i] = frame;
  }
  trouble("");
  draw();
  const { bitmap, distance } = frames[0];
  if (!isMoving) complete = asked;
  pace(frames, begun, isMoving, part);
  stage.dataset.pictures = Number(stage.dataset.pictures || 0) + 1;
  stage.dataset.size = `${bitmap.width}x${bitmap.height}`;
  // Colours measured in only some of the views are requested again.
  const isPart = frames.some((frame) => frame?.measured && frame.measured[0] < frame.measured[1]);
  if (isPart && complete === version) complete = last.version = -1;
  stage.dataset.state = complete === version ? "sharp" : isPart ? "measuring" : "moving";
  if (complete !== version) return;
  // The next orbit is about the centre of the picture.
  if (distance) camera.away = distance;
  stage.dataset.rested = rested();
  measureLatency();
}

/** Measures the latency while the picture rests and no other request is pending. */
async function measureLatency() {
  const begun = performance.now();
  const answer = await fetch("", { method: "HEAD" }).catch(() => null);
  if (answer?.ok) latency = performance.now() - begun;
}

/** Time since the last change [ms]. */
const rested = () => Math.round(performance.now() - changedAt);

/**
 * Shows the time of the picture, and adapts the coarse size so that movement stays smooth. It adapts to the time for
 * rendering and transfer only, as fewer pixels shorten neither the latency nor the work of the browser.
 */
function pace(frames, begun, isMoving, part) {
  const all = frames.filter(Boolean), most = (value) => Math.max(...all.map(value));
  const total = (value) => all.reduce((sum, frame) => sum + value(frame), 0);
  const bytes = total((frame) => frame.bytes), making = total((frame) => frame.milliseconds);
  const took = most((frame) => frame.took), transfer = most((frame) => frame.took - frame.held);
  const { bitmap, milliseconds } = frames[0];
  const size = `${bitmap.width} × ${bitmap.height}`;
  const now = performance.now(), since = Math.max(begun, shownAt);
  shownAt = now;
  // Requests come no faster than they are served.
  spacing = most((frame) => frame.held);
  if (isMoving) {
    // The time that each of the pending requests may take to keep the pace.
    const allowed = clamp(inFlight() * PACE - latency, PACE / 2, PACE);
    coarse = clamp(part * clamp(Math.sqrt(allowed / (making + bytes * perByte)), 0.8, 1.1), 0.12, 1);
    paces = [...paces.slice(-11), now - since];
    const mean = paces.reduce((sum, x) => sum + x, 0) / paces.length;
    stage.dataset.rate = (1000 / mean).toFixed(1);
    byId("status").textContent = `${size} · ${Math.round(1000 / mean)} pictures/s · ${took.toFixed(0)} ms`;
  } else {
    // The sharp picture is the largest, which gives the best estimate of the time per byte.
    perByte = Math.max(0, transfer - latency) / bytes;
    const [seen, every] = frames.find((frame) => frame?.measured)?.measured ?? [0, 0];
    const how = seen < every ? `measured in ${seen} of ${every} training views` : `sharp after ${rested()} ms, drawn in ${milliseconds.toFixed(0)}`;
    byId("status").textContent = `${size} · ${how}`;
  }
}

function trouble(message) {
  byId("trouble").hidden = !message;
  byId("trouble").textContent = message;
}

/** Draws the pictures and the marks over them. */
function draw() {
  const ratio = devicePixelRatio;
  const [width, height] = area();
  for (const canvas of [picture, marks]) {
    const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
  }
  const out = picture.getContext("2d");
  out.setTransform(1, 0, 0, 1, 0, 0);
  out.clearRect(0, 0, picture.width, picture.height);
  out.imageSmoothingQuality = "high";
  const isSplit = Boolean(shown[1]);
  shown.forEach((frame, side) => {
    if (!frame) return;
    const { bitmap } = frame;
    const [w, h] = fit([bitmap.width, bitmap.height], [picture.width, picture.height]);
    const [x, y] = [(picture.width - w) / 2, (picture.height - h) / 2];
    const cut = border * picture.width;
    out.save();
    out.beginPath();
    if (isSplit) out.rect(side ? cut : 0, 0, side ? picture.width - cut : cut, picture.height);
    else out.rect(0, 0, picture.width, picture.height);
    out.clip();
    out.drawImage(bitmap, x, y, w, h);
    out.restore();
  });
  byId("divider").hidden = !isSplit;
  byId("divider").style.left = `${100 * border}%`;
  byId("divider").setAttribute("aria-valuenow", Math.round(100 * border));
  for (const [side, id] of [[0, "left-name"], [1, "right-name"]]) {
    byId(id).hidden = !isSplit;
    if (isSplit && shown[side]) byId(id).textContent = caption(shown[side]);
  }
  if (shown[0]) describe();
  drawMarks(ratio);
}

function caption({ kind, model }) {
  const { label, needs_photograph: isPhotograph } = kindOf(kind);
  const suffix = scene.models.length > 1 && !(isPhotograph && kind === "photograph") ? `, ${scene.models[model].name}` : "";
  return label + suffix;
}

/** Explains the colours of the first picture that represents numbers. */
function describe() {
  const frame = shown.find((frame) => frame && frame.range) || shown[0];
  const { about, unit: name, label } = kindOf(frame.kind);
  byId("about").textContent = about;
  byId("legend").hidden = !frame.range;
  byId("mean").hidden = frame.mean === null;
  const brief = (x) => Math.abs(x) >= 1e5 || (x && Math.abs(x) < 1e-3) ? x.toExponential(1) : String(Number(x.toPrecision(3)));
  if (frame.range) {
    byId("least").textContent = brief(frame.range[0]);
    byId("most").textContent = brief(frame.range[1]) + (frame.kind === "difference" ? " and more" : "");
    byId("unit").textContent = name;
  }
  if (frame.mean !== null) byId("mean").textContent = `${label}: ${brief(frame.mean)} on average.`;
}

// ---- Marks: cameras and points, drawn here over the picture.

/** Returns a function that projects a point of the world to pixels of `marks`, and to depth. */
function projector() {
  const [width, height] = fit(shape(), [marks.width, marks.height]);
  const focal = 1 / 2 / Math.tan(radians(camera.fov) / 2);
  // The principal point of a photograph need not be its centre.
  const [fx, fy, cx, cy] = view ? scene.views[view.split][view.number].lens : [focal * height / width, focal, 0.5, 0.5];
  const [left, top] = [(marks.width - width) / 2, (marks.height - height) / 2];
  const { right, up, back, at } = camera;
  return (world) => {
    const d = add(world, at, -1);
    const z = -dot(d, back);
    return [left + width * (cx + fx * dot(d, right) / z), top + height * (cy - fy * dot(d, up) / z), z];
  };
}

/** The centre of a camera and the corners of its frustum, in the world. */
function frustum({ camera_to_world: m, lens: [fx, fy, cx, cy] }) {
  const axis = (i) => [m[i], m[4 + i], m[8 + i]];
  const centre = axis(3), size = 0.06 * scene.radius;
  const [left, right, top, bottom] = [-cx / fx, (1 - cx) / fx, cy / fy, (cy - 1) / fy].map((part) => part * size);
  const corner = (x, y) => add(add(add(centre, axis(0), x), axis(1), y), axis(2), -size);
  return [centre, corner(left, top), corner(right, top), corner(right, bottom), corner(left, bottom)];
}

function drawMarks(ratio) {
  const out = marks.getContext("2d");
  out.clearRect(0, 0, marks.width, marks.height);
  const project = projector();
  const least = 0.01 * scene.radius;
  if (byId("points").checked) {
    const size = 2 * ratio;
    scene.points.positions.forEach((point, i) => {
      const [x, y, z] = project(point);
      if (z < least) return;
      const [r, g, b] = scene.points.colours[i];
      out.fillStyle = `rgb(${r} ${g} ${b})`;
      out.fillRect(x - size / 2, y - size / 2, size, size);
    });
  }
  if (!byId("frusta").checked) return;
  const style = getComputedStyle(document.documentElement);
  out.lineWidth = 1.5 * ratio;
  for (const [split, colour] of [["train", "--trained"], ["test", "--held"]]) {
    out.strokeStyle = style.getPropertyValue(colour);
    out.beginPath();
    scene.views[split].forEach((at, number) => {
      // The current camera would only frame the picture.
      if (view && view.split === split && view.number === number) return;
      const corners = frustum(at).map(project);
      if (corners.some(([, , z]) => z < least)) return;
      const line = (a, b) => { out.moveTo(a[0], a[1]); out.lineTo(b[0], b[1]); };
      for (let i = 1; i <= 4; i += 1) {
        line(corners[0], corners[i]);
        line(corners[i], corners[i % 4 + 1]);
      }
    });
    out.stroke();
  }
}

/** The drawn camera at this position on the screen, if any. */
function cameraAt(x, y) {
  if (!byId("frusta").checked) return null;
  const project = projector(), ratio = devicePixelRatio;
  let found = null, nearest = 14;
  for (const split of ["test", "train"]) {
    scene.views[split].forEach((at, number) => {
      const [px, py, z] = project(frustum(at)[0]);
      const distance = Math.hypot(px / ratio - x, py / ratio - y);
      if (z > 0 && distance < nearest) [found, nearest] = [{ split, number }, distance];
    });
  }
  return found;
}

// ---- Moving.

/** The effect of dragging and of the arrow keys: as chosen in the panel, or shifting with Shift or another button. */
const modeOf = ({ shiftKey, buttons = 0 }) =>
  shiftKey || buttons & 6 ? "pan" : document.querySelector("input[name=drag]:checked").value;

/** Pressed pointers and their last positions, in pixels of the page. */
const pointers = new Map();
let travelled = 0;

marks.addEventListener("pointerdown", (event) => {
  // A mouse or a first finger starts a new gesture.
  if (event.isPrimary) endDragging();
  marks.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, [event.clientX, event.clientY]);
  marks.classList.add("dragging");
  travelled = 0;
});

// Listens on the whole page, as not every browser honours the capture: dragging continues outside the picture.
addEventListener("pointermove", (event) => {
  const before = pointers.get(event.pointerId);
  if (!before) return;
  // The button was released outside the page.
  if (!event.buttons) return endDragging();
  const now = [event.clientX, event.clientY];
  const [dx, dy] = add(now, before, -1);
  if (!dx && !dy) return;
  const height = area()[1];
  travelled += Math.hypot(dx, dy);
  if (travelled < 4 && pointers.size === 1) return;
  if (pointers.size === 2) {
    // Two fingers: their centre shifts the scene, their distance moves the camera.
    const other = [...pointers].find(([id]) => id !== event.pointerId)[1];
    const spread = (a) => Math.max(10, Math.hypot(a[0] - other[0], a[1] - other[1]));
    dolly(spread(before) / spread(now));
    pan(dx / 2 / height, dy / 2 / height);
  } else {
    const mode = modeOf(event);
    if (mode === "pan") pan(dx / height, dy / height);
    else if (mode === "look") look(radians(camera.fov) * dx / height, radians(camera.fov) * dy / height);
    else orbit(4 * dx / height, 4 * dy / height);
  }
  pointers.set(event.pointerId, now);
});

/** Ends all dragging. */
function endDragging() {
  pointers.clear();
  marks.classList.remove("dragging");
}

addEventListener("pointerup", (event) => {
  if (!pointers.delete(event.pointerId)) return;
  if (!pointers.size) endDragging();
  const found = travelled < 4 && event.target === marks && cameraAt(event.offsetX, event.offsetY);
  if (found) goTo(found);
});
addEventListener("pointercancel", (event) => { if (pointers.has(event.pointerId)) endDragging(); });
marks.addEventListener("contextmenu", (event) => event.preventDefault());
marks.addEventListener("wheel", (event) => {
  event.preventDefault();
  dolly(Math.exp(clamp(event.deltaY * (event.deltaMode ? 30 : 1), -300, 300) * 0.0015));
}, { passive: false });

/** Flying keys and their directions along right, up and back. */
const FLIGHT = { w: [0, 0, -1], s: [0, 0, 1], a: [-1, 0, 0], d: [1, 0, 0], e: [0, 1, 0], q: [0, -1, 0] };
const pressedKeys = new Set();
const isFlying = () => pressedKeys.size > 0 || flight !== null;
let ticked = 0;

function fly(now) {
  if (!pressedKeys.size) return;
  const seconds = Math.min(0.1, (now - ticked) / 1000);
  ticked = now;
  const sum = [...pressedKeys].reduce((sum, key) => add(sum, FLIGHT[key]), [0, 0, 0]);
  const step = 0.6 * scene.radius * 2 ** Number(byId("speed").value) * seconds;
  leaveView();
  ["right", "up", "back"].forEach((name, i) => { camera.at = add(camera.at, camera[name], step * sum[i]); });
  changed();
  requestAnimationFrame(fly);
}

const STEPS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

document.addEventListener("keydown", (event) => {
  const { target, key } = event;
  if (!scene || event.ctrlKey || event.metaKey || event.altKey || byId("guide").open) return;
  // A focused control keeps the keys that it needs itself.
  const needed = STEPS[key] ? "select, input:not([type=checkbox]), [role=slider]" : "select";
  if (target.matches(needed)) return;
  const low = key.toLowerCase();
  if (FLIGHT[low]) {
    if (!pressedKeys.size) { ticked = performance.now(); requestAnimationFrame(fly); }
    pressedKeys.add(low);
  } else if (STEPS[key]) {
    const [x, y] = STEPS[key], mode = modeOf(event);
    if (mode === "pan") pan(-0.05 * x, -0.05 * y);
    else if (mode === "look") look(-0.06 * x, -0.06 * y);
    else orbit(0.06 * x, 0.06 * y);
  } else if (key === "+" || key === "=") dolly(0.9);
  else if (key === "-") dolly(1 / 0.9);
  else if (key === "[") step(-1);
  else if (key === "]") step(1);
  else if (low === "r") goHome();
  else if (low === "k") addKeyframe();
  else if (low === "h" || key === "?") showHelp();
  else return;
  event.preventDefault();
});
document.addEventListener("keyup", (event) => { pressedKeys.delete(event.key.toLowerCase()); changedAt = performance.now(); wake(); });
addEventListener("blur", () => { pressedKeys.clear(); endDragging(); });

// ---- The border between two pictures.

const divider = byId("divider");
const setBorder = (share) => { border = clamp(share, 0, 1); draw(); };
let dragger = null;
divider.addEventListener("pointerdown", (event) => {
  divider.setPointerCapture(event.pointerId);
  dragger = event.pointerId;
});
addEventListener("pointermove", (event) => {
  if (event.pointerId !== dragger) return;
  if (event.buttons) setBorder((event.clientX - stage.getBoundingClientRect().left) / area()[0]);
  else dragger = null;
});
for (const end of ["pointerup", "pointercancel"]) {
  addEventListener(end, (event) => { if (event.pointerId === dragger) dragger = null; });
}
divider.addEventListener("keydown", (event) => {
  const to = { ArrowLeft: border - 0.02, ArrowRight: border + 0.02, Home: 0, End: 1 }[event.key];
  if (to === undefined) return;
  setBorder(to);
  event.preventDefault();
});

// ---- Cameras of the photographs.

/** All views in the order of the menu. */
const allViews = () => ["test", "train"].flatMap((split) => scene.views[split].map((_, number) => ({ split, number })));

function goTo(to) {
  view = to;
  const at = scene.views[to.split][to.number];
  setPose(at);
  byId("view").value = `${to.split}:${to.number}`;
  showControls();
  changed();
}

function step(by) {
  const all = allViews();
  if (!all.length) return;
  const now = view ? all.findIndex(({ split, number }) => split === view.split && number === view.number) : -1;
  goTo(all[now < 0 ? (by > 0 ? 0 : all.length - 1) : (now + by + all.length) % all.length]);
}

function goHome() {
  const all = allViews();
  camera.away = scene.radius;
  if (all.length) goTo(all[0]);
  else { setPose(scene.start); camera.away = length(add(camera.at, scene.pivot, -1)); showControls(); changed(); }
}

// ---- Camera paths, in nerfstudio's format, which densify render reads.

const keyframes = [];
let flight = null;

function addKeyframe() {
  keyframes.push({ ...pose(), aspect: area()[0] / area()[1] });
  showPath();
}

function showPath() {
  const count = keyframes.length;
  byId("path-state").textContent = count
    ? `${count} ${count === 1 ? "camera" : "cameras"}. Saved, densify render RUN -o frames --path FILE flies along them.`
    : "Add cameras; densify render --path FILE flies along them.";
  byId("remove").disabled = !count;
  byId("save").disabled = !count;
  byId("play").disabled = count < 2;
  byId("play").textContent = flight ? "Stop" : "Fly along";
}

/** The rotation as a quaternion (w, x, y, z). */
function quaternion({ camera_to_world: m }) {
  const s = (a, b, c) => Math.sqrt(Math.max(0, 1 + a * m[0] + b * m[5] + c * m[10])) / 2;
  const withSign = (x, other) => other < 0 ? -x : x;
  return [s(1, 1, 1), withSign(s(1, -1, -1), m[9] - m[6]), withSign(s(-1, 1, -1), m[2] - m[8]), withSign(s(-1, -1, 1), m[4] - m[1])];
}

/** Sets the camera to a position on the path, a Catmull-Rom spline, in intervals from its first camera. */
function setOnPath(place) {
  const loops = byId("loop").checked, count = keyframes.length;
  const first = Math.min(Math.floor(place), loops ? count - 1 : count - 2), t = place - first;
  const key = (i) => keyframes[loops ? (i + count) % count : clamp(i, 0, count - 1)];
  const near = [first - 1, first, first + 1, first + 2].map(key);
  const t2 = t * t, t3 = t2 * t;
  const weights = [2 * t2 - t - t3, 3 * t3 - 5 * t2 + 2, t + 4 * t2 - 3 * t3, t3 - t2].map((w) => w / 2);
  const mix = (values) => values.reduce((sum, value, i) => add(sum, value, weights[i]), values[0].map(() => 0));
  const turns = near.map(quaternion), along = turns[1];
  const signed = turns.map((q) => q.reduce((sum, x, i) => sum + x * along[i], 0) < 0 ? scale(q, -1) : q);
  const mean = mix(signed), size = Math.hypot(...mean) || 1;
  const [w, x, y, z] = scale(mean, 1 / size);
  camera.right = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)];
  camera.up = [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)];
  camera.back = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)];
  camera.at = mix(near.map(({ camera_to_world: m }) => [m[3], m[7], m[11]]));
  const zoom = near.reduce((sum, { fov }, i) => sum + weights[i] * Math.log(Math.tan(radians(fov) / 2)), 0);
  camera.fov = 2 * Math.atan(Math.exp(zoom)) * 180 / Math.PI;
}

/** Number of intervals between cameras of the path. */
const intervals = () => keyframes.length - (byId("loop").checked ? 0 : 1);

function play() {
  flight = flight ? null : performance.now();
  view = null;
  byId("view").value = "";
  showControls();
  showPath();
  const next = (now) => {
    if (flight === null) return;
    // Two seconds per interval.
    const place = Math.max(0, now - flight) / 2000;
    if (place >= intervals()) flight = null;
    setOnPath(Math.min(place, intervals()));
    changed();
    if (flight === null) { showPath(); showControls(); }
    else requestAnimationFrame(next);
  };
  if (flight !== null) requestAnimationFrame(next);
}

function savePath() {
  const [width, height] = area().map((side) => Math.round(side * devicePixelRatio));
  const path = {
    camera_type: "perspective", render_width: width, render_height: height, fps: 30,
    seconds: 2 * Math.max(1, intervals()), is_cycle: byId("loop").checked, camera_path: keyframes,
  };
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([JSON.stringify(path, null, 1)], { type: "application/json" }));
  link.download = "camera_path.json";
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

// ---- The panel.

function showControls() {
  byId("fov").value = Math.round(camera.fov);
  byId("fov-value").textContent = `${Math.round(camera.fov)}°`;
  byId("speed-value").textContent = `× ${Number(2 ** byId("speed").value).toPrecision(2)}`;
  // Pictures that need a photograph are available only at the camera of a view.
  for (const select of [byId("left"), byId("right")]) {
    for (const option of select.options) {
      if (option.value && kindOf(choice(option.value).kind).needs_photograph) option.disabled = !view;
    }
    if (select.selectedOptions[0]?.disabled) select.value = select.options[0].value;
  }
}

/** Shows the number of Gaussians of each model. */
function showModels() {
  byId("models").replaceChildren(...scene.models.map(({ name, rows }) => {
    const item = document.createElement("li");
    item.textContent = `${name}: ${rows.toLocaleString("en")} Gaussians`;
    return item;
  }));
}

function fillPanel() {
  document.title = `${scene.title} · densify view`;
  byId("title").textContent = scene.title;
  showModels();
  const option = (value, text) => new Option(text, value);
  byId("right").append(option("", "nothing"));
  const isOfModel = (kind) => kind !== "photograph";
  scene.models.forEach(({ name }, model) => {
    const suffix = scene.models.length > 1 ? `, ${name}` : "";
    for (const list of [byId("left"), byId("right")]) {
      for (const [title, isRows] of [["Pictures", false], ["Single Gaussians", true]]) {
        const group = document.createElement("optgroup");
        group.label = title + suffix;
        for (const { kind, label } of scene.kinds) {
          if (kind.startsWith("row") !== isRows || model && !isOfModel(kind)) continue;
          group.append(option(`${kind}:${model}`, isOfModel(kind) ? label + suffix : label));
        }
        list.append(group);
      }
    }
  });
  byId("lacking").hidden = !scene.lacking.length;
  for (const { label, why } of scene.lacking) {
    const item = document.createElement("li");
    item.textContent = `${label}: ${why}.`;
    byId("lacking").querySelector("ul").append(item);
  }
  if (scene.models.length > 1) byId("right").value = "render:1";
  byId("view").append(option("", "anywhere"));
  for (const [split, label] of [["test", "Held out"], ["train", "Trained on"]]) {
    if (!scene.views[split].length) continue;
    const group = document.createElement("optgroup");
    group.label = label;
    scene.views[split].forEach(({ name }, number) => group.append(option(`${split}:${number}`, name)));
    byId("view").append(group);
  }
  byId("cameras").hidden = !allViews().length;
  byId("points-label").hidden = !scene.points.positions.length;
  byId("ramp").style.background = `linear-gradient(to right, ${scene.ramp.map((c) => `rgb(${c.join(" ")})`).join(", ")})`;
}

/** Opens the help, scrolled to its beginning: on a small screen the focused button is far below. */
function showHelp() {
  byId("guide").showModal();
  byId("guide").scrollTop = 0;
}

function addListeners() {
  const on = (id, event, action) => byId(id).addEventListener(event, action);
  for (const id of ["left", "right", "sharpness"]) on(id, "change", changed);
  for (const id of ["frusta", "points"]) on(id, "change", draw);
  on("view", "change", () => {
    const [split, number] = byId("view").value.split(":");
    if (split) goTo({ split, number: Number(number) });
    else { leaveView(); changed(); }
  });
  on("before", "click", () => step(-1));
  on("after", "click", () => step(1));
  on("home", "click", goHome);
  on("fov", "input", () => { leaveView(); camera.fov = Number(byId("fov").value); showControls(); changed(); });
  on("speed", "input", showControls);
  on("add", "click", addKeyframe);
  on("remove", "click", () => { keyframes.pop(); showPath(); });
  on("play", "click", play);
  on("save", "click", savePath);
  on("help", "click", showHelp);
  on("fold", "click", () => {
    const isFolded = document.body.classList.toggle("folded");
    byId("fold").textContent = isFolded ? "Show panel" : "Hide panel";
    byId("fold").setAttribute("aria-expanded", String(!isFolded));
  });
  on("guide", "close", () => {
    try { localStorage.setItem("densify-view", "seen"); } catch { /* Without storage, the help is shown every time. */ }
    marks.focus();
  });
  document.addEventListener("visibilitychange", wake);
  new ResizeObserver(() => { draw(); changed(); }).observe(stage);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
}

async function open() {
  try {
    const answer = await fetch("scene");
    if (!answer.ok) throw new Error(await answer.text());
    scene = await answer.json();
  } catch (error) {
    trouble(`The scene cannot be read: ${error.message}`);
    return;
  }
  fillPanel();
  goHome();
  showPath();
  addListeners();
  let isNew = true;
  try { isNew = localStorage.getItem("densify-view") === null; } catch { /* Without storage, show the help. */ }
  if (isNew) showHelp();
  keepAsking();
  if (scene.live) followTraining(requestPicture);
}

open();
