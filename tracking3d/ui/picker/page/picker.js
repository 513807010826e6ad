// Draws boxes, points and paint on a frame; the server makes masks of them. No library, no network but our own.
"use strict";

const COLOURS = ["#00a5e0", "#e64ba0", "#7cb518", "#f08c1e", "#8f6ce0", "#e5484d"];
const HINTS = {
  box: "Drag a box around the object." + (matchMedia("(pointer: fine)").matches ? " The mouse wheel zooms." : ""),
  on: "Click on the object. Right click marks the background.",
  beside: "Click on the background.",
  paint: "Paint over the object.",
  erase: "Erase what is not the object.",
};
const PRESENT = "This is the mask of the run. Paint and Erase change it; a box or points replace it.";
const byId = (id) => document.getElementById(id);
const canvas = byId("canvas");
const context = canvas.getContext("2d");

let session = null;
let frame = 0;
let picture = null; // the image of the frame
let tool = "box";
let objects = [];
let current = 0;
let pressed = null; // what is being drawn: {kind, ...}
let zoom = 1;
let asked = 0; // number of the last question for a mask
let present = null; // the mask that the run has of this frame, if a run is corrected
let running = false; // whether the run is being corrected
let veils = null; // the masks of the run's latest frame, once it has started
let viewer = null; // its address, once it is open
let stopped = false; // whether it was stopped from here

const one = () => objects[current];
const isEmpty = (object) => !object.box && !object.points.length && !object.strokes.length;

function newObject() {
  const number = objects.length;
  return { name: number ? `object ${number + 1}` : "object", colour: COLOURS[number % COLOURS.length],
    frame, box: null, points: [], strokes: [], veil: null, before: [], told: "" };
}

// What the server is told of an object.
function plain(object) {
  const { name, colour, frame, box, points, strokes } = object;
  return { name: name.trim() || "object", colour, frame, box, points, strokes };
}

async function ask(path, body) {
  const answer = await fetch(path, { method: "POST", headers: { "Content-Type": "application/json" },
    body: JSON.stringify(body) });
  if (!answer.ok) throw new Error((await answer.text()).trim());
  return answer.json();
}

function say(text, problem = false) {
  byId("status").textContent = text;
  byId("status").classList.toggle("problem", problem);
}

// ---- drawing ----

function resize() {
  const stage = byId("stage");
  const scale = Math.min((stage.clientWidth - 20) / session.width, (stage.clientHeight - 20) / session.height);
  canvas.style.width = `${Math.max(session.width * scale, 50) * zoom}px`;
  canvas.style.height = `${Math.max(session.height * scale, 50) * zoom}px`;
  canvas.width = session.width;
  canvas.height = session.height;
  draw();
}

// The wheel looks closer, at the place under the pointer.
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  const stage = byId("stage");
  const before = canvas.getBoundingClientRect();
  const x = (event.clientX - before.left) / before.width;
  const y = (event.clientY - before.top) / before.height;
  zoom = Math.min(Math.max(zoom * Math.exp(-event.deltaY / 400), 1), 12);
  resize();
  const after = canvas.getBoundingClientRect();
  stage.scrollLeft += after.left + x * after.width - event.clientX;
  stage.scrollTop += after.top + y * after.height - event.clientY;
}, { passive: false });

function draw() {
  context.clearRect(0, 0, canvas.width, canvas.height);
  if (picture) context.drawImage(picture, 0, 0, canvas.width, canvas.height);
  const unit = session.width / canvas.clientWidth; // frame pixels of a pixel of the screen
  if (present && !(one().frame === frame && one().veil)) context.drawImage(present, 0, 0);
  for (const veil of veils ?? []) context.drawImage(veil, 0, 0);
  objects.forEach((object, number) => {
    if (object.frame !== frame || veils) return;
    context.globalAlpha = number === current ? 1 : 0.6;
    if (object.veil) context.drawImage(object.veil, 0, 0);
    if (number !== current) return;
    drawMarks(object, unit);
  });
  context.globalAlpha = 1;
  if (pressed?.kind === "box") drawBox(pressed.box, one().colour, unit);
  if (pressed?.kind === "stroke") drawStroke(pressed.stroke, one().colour);
}

function drawMarks(object, unit) {
  if (object.box) drawBox(object.box, object.colour, unit);
  for (const point of object.points) {
    context.beginPath();
    context.arc(point.x, point.y, 6 * unit, 0, 7);
    context.fillStyle = point.on ? "#2ecc52" : "#e5484d";
    context.fill();
    context.lineWidth = 2 * unit;
    context.strokeStyle = "#fff";
    context.stroke();
    context.beginPath();
    context.moveTo(point.x - 3 * unit, point.y);
    context.lineTo(point.x + 3 * unit, point.y);
    if (point.on) {
      context.moveTo(point.x, point.y - 3 * unit);
      context.lineTo(point.x, point.y + 3 * unit);
    }
    context.stroke();
  }
}

function drawBox([x, y, width, height], colour, unit) {
  context.lineWidth = 4 * unit;
  context.strokeStyle = "#0008";
  context.strokeRect(x, y, width, height);
  context.lineWidth = 2 * unit;
  context.strokeStyle = colour;
  context.strokeRect(x, y, width, height);
}

function drawStroke(stroke, colour) {
  context.globalAlpha = 0.5;
  context.lineWidth = 2 * stroke.radius;
  context.lineCap = context.lineJoin = "round";
  context.strokeStyle = stroke.on ? colour : "#e5484d";
  context.beginPath();
  stroke.path.forEach(([x, y], place) => (place ? context.lineTo(x, y) : context.moveTo(x, y)));
  if (stroke.path.length === 1) context.lineTo(stroke.path[0][0] + 0.01, stroke.path[0][1]);
  context.stroke();
  context.globalAlpha = 1;
}

// ---- what the person does on the frame ----

function place(event) {
  const area = canvas.getBoundingClientRect();
  const inside = (value, most) => Math.round(Math.min(Math.max(value, 0), most) * 10) / 10;
  return [inside((event.clientX - area.left) / area.width * session.width, session.width),
    inside((event.clientY - area.top) / area.height * session.height, session.height)];
}

// Room for one more change, which can be undone. An object is of the frame that it is drawn on.
function begin() {
  const object = one();
  object.before.push({ frame: object.frame, box: object.box, points: object.points, strokes: object.strokes });
  if (object.frame !== frame) Object.assign(object, { frame, box: null, points: [], strokes: [], veil: null });
}

canvas.addEventListener("contextmenu", (event) => event.preventDefault());

canvas.addEventListener("pointerdown", (event) => {
  if (pressed || event.button === 1) return;
  canvas.setPointerCapture(event.pointerId);
  const [x, y] = place(event);
  if (tool === "on" || tool === "beside") {
    if (one().points.length >= 200) return say("An object can have at most 200 points.", true);
    begin();
    one().points = [...one().points, { x, y, on: tool === "on" && event.button !== 2 }];
    return changed();
  }
  pressed = tool === "box" ? { kind: "box", x, y, box: [x, y, 0, 0] }
    : { kind: "stroke", stroke: { path: [[x, y]], radius: Number(byId("brush").value) / 2 * session.width / canvas.clientWidth,
      on: tool === "paint" && event.button !== 2 } };
  draw();
});

canvas.addEventListener("pointermove", (event) => {
  if (!pressed) return;
  const [x, y] = place(event);
  if (pressed.kind === "box") {
    pressed.box = [Math.min(x, pressed.x), Math.min(y, pressed.y), Math.abs(x - pressed.x), Math.abs(y - pressed.y)];
  } else if (pressed.stroke.path.length < 2000) {
    pressed.stroke.path.push([x, y]);
  }
  draw();
});

canvas.addEventListener("pointerup", () => {
  const was = pressed;
  pressed = null;
  if (!was) return;
  if (was.kind === "box") {
    if (was.box[2] < 3 || was.box[3] < 3) return draw(); // a click is no box
    begin();
    one().box = was.box;
  } else {
    if (one().strokes.length >= 400) return say("An object can have at most 400 strokes; undo some.", true);
    begin();
    one().strokes = [...one().strokes, was.stroke];
  }
  changed();
});

canvas.addEventListener("pointercancel", () => { pressed = null; draw(); });

// ---- masks ----

let waiting = null;

function changed() {
  draw();
  list();
  clearTimeout(waiting);
  waiting = setTimeout(showMask, 120);
}

async function showMask() {
  const object = one();
  if (isEmpty(object)) {
    object.veil = null;
    object.told = "";
    say(present ? PRESENT : "");
    list();
    return draw();
  }
  const number = ++asked;
  say(`${session.tracker} is computing the mask …`);
  try {
    const { veil, area } = await ask("mask", plain(object));
    if (number !== asked) return;
    const image = new Image();
    image.src = veil;
    await image.decode();
    object.veil = image;
    object.told = `${area} px`;
    say(session.correcting ? "The run continues from this mask." : "The run starts from this mask.");
  } catch (error) {
    if (number !== asked) return;
    object.veil = null;
    object.told = "";
    say(error.message, true);
  }
  list();
  draw();
}

// ---- the list of objects ----

function list() {
  byId("objects").replaceChildren(...objects.map((object, number) => {
    const row = document.createElement("li");
    row.setAttribute("aria-current", number === current);
    const colour = Object.assign(document.createElement("input"), { type: "color", value: object.colour, title: "Colour" });
    colour.addEventListener("change", () => { object.colour = colour.value; current = number; changed(); });
    const name = Object.assign(document.createElement("input"), { type: "text", value: object.name, maxLength: 40 });
    name.setAttribute("aria-label", "Name");
    name.addEventListener("focus", () => choose(number));
    name.addEventListener("input", () => { object.name = name.value; });
    const told = document.createElement("small");
    told.textContent = isEmpty(object) ? "not marked" : object.frame === frame ? object.told : `frame ${object.frame}`;
    const remove = Object.assign(document.createElement("button"), { textContent: "✕", title: "Remove" });
    remove.addEventListener("click", () => {
      objects.splice(number, 1);
      if (!objects.length) objects.push(newObject());
      current = Math.min(current, objects.length - 1);
      list();
      draw();
    });
    row.addEventListener("click", (event) => { if (event.target === row || event.target === told) choose(number); });
    row.append(colour, name, told, remove);
    return row;
  }));
  const ready = objects.some((object) => !isEmpty(object));
  for (const id of ["start", "save", "yaml"]) byId(id).disabled = !ready;
  byId("undo").disabled = !one().before.length;
  byId("clear").disabled = isEmpty(one());
}

function choose(number) {
  if (number === current) return;
  current = number;
  [...byId("objects").children].forEach((row, place) => row.setAttribute("aria-current", place === current));
  byId("undo").disabled = !one().before.length;
  byId("clear").disabled = isEmpty(one());
  draw();
}

byId("add").addEventListener("click", () => {
  if (objects.length >= 16) return say("A run can have at most 16 objects.", true);
  objects.push(newObject());
  current = objects.length - 1;
  list();
  draw();
});

byId("undo").addEventListener("click", undo);
byId("clear").addEventListener("click", () => {
  begin();
  Object.assign(one(), { box: null, points: [], strokes: [] });
  changed();
});

function undo() {
  const before = one().before.pop();
  if (!before) return;
  Object.assign(one(), before);
  changed();
}

// ---- tools and frames ----

function take(name) {
  tool = name;
  for (const button of document.querySelectorAll("#tools button")) {
    button.setAttribute("role", "radio");
    button.setAttribute("aria-checked", button.dataset.tool === tool);
  }
  byId("hint").textContent = HINTS[tool];
}

for (const button of document.querySelectorAll("#tools button")) {
  button.addEventListener("click", () => take(button.dataset.tool));
}

const KEYS = { b: "box", o: "on", i: "beside", p: "paint", e: "erase" };
document.addEventListener("keydown", (event) => {
  if (event.target.matches("input[type=text], input[type=number], select")) return;
  if ((event.ctrlKey || event.metaKey) && event.key === "z") return undo();
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (KEYS[event.key]) take(KEYS[event.key]);
  const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
  if (step && event.target.id !== "frame") goTo(frame + step * session.step);
});

let loading = 0;

function goTo(index) {
  const { first, last, step } = session;
  const near = first + Math.round((Math.min(Math.max(index, first), last) - first) / step) * step;
  const number = ++loading;
  const image = new Image();
  image.onload = () => { if (number === loading) { picture = image; draw(); } };
  image.onerror = () => { if (number === loading) { picture = null; say(`Frame ${near} cannot be read.`, true); draw(); } };
  image.src = `frame/${near}.jpg`;
  frame = near;
  byId("frame").value = byId("number").value = near;
  if (session.correcting) {
    if (isEmpty(one())) say("");
    showPresent();
  }
  list();
  draw();
}

byId("frame").addEventListener("input", (event) => goTo(Number(event.target.value)));
byId("number").addEventListener("change", (event) => goTo(Number(event.target.value) || session.first));

// ---- settings of the run ----

const UNCHOSEN = { quality: "not given", fov: "vertical, degrees", intrinsics: "fx, fy, cx, cy" };
let settled = Promise.resolve(); // the last change of settings has arrived

function offerSettings() {
  byId("settings").hidden = false;
  for (const control of document.querySelectorAll("[data-setting]")) {
    const words = session.choices[control.dataset.setting];
    const use = (word) => control.dataset.setting === "tracker" && session.tracker_for[word];
    const line = (word) => (use(word) ? `${word}: ${use(word)}` : word);
    if (words) control.replaceChildren(new Option("", ""), ...words.map((word) => new Option(line(word), word)));
    control.addEventListener("change", () => { settled = settled.then(changeSettings); });
  }
  showSettings();
}

// Settings that were not chosen are those of the quality, the preset or the configuration file.
function showSettings() {
  for (const control of document.querySelectorAll("[data-setting]")) {
    const name = control.dataset.setting, value = session.chosen[name];
    control.value = Array.isArray(value) ? value.join(", ") : value ?? "";
    const unchosen = control.options?.[0];
    if (unchosen) unchosen.textContent = session.usual[name] && !value ? `default (${session.usual[name]})` : UNCHOSEN[name] ?? "default";
  }
  const named = session.chosen.tracker ?? session.tracker, use = session.tracker_for[named];
  byId("tracker-for").textContent = use ? `${named}: ${use}` : "";
  byId("source").textContent = `${session.source}, ${session.width} x ${session.height}, tracker ${session.tracker}`;
}

async function changeSettings() {
  const chosen = {};
  for (const control of document.querySelectorAll("[data-setting]")) {
    const name = control.dataset.setting, text = control.value.trim();
    chosen[name] = text === "" ? null : name === "fov" ? Number(text)
      : name === "intrinsics" ? text.split(/[\s,]+/).map(Number) : text;
  }
  try {
    Object.assign(session, await ask("settings", chosen));
    say("");
  } catch (error) {
    showSettings();
    return say(`${error.message} The settings are as before.`, true);
  }
  showSettings();
  if (!isEmpty(one())) await showMask();
}

// ---- how it ends ----

async function end(path) {
  say("One moment …");
  await settled;
  try {
    const told = await ask(path, { objects: objects.filter((object) => !isEmpty(object)).map(plain) });
    say("");
    return told;
  } catch (error) {
    say(error.message, true);
    return null;
  }
}

async function copy(text, what) {
  byId("told").hidden = false;
  byId("told").textContent = text;
  try {
    await navigator.clipboard.writeText(text);
    say(`${what} was copied to the clipboard and is shown below.`);
  } catch {
    say(`${what} is shown below.`);
  }
}

byId("save").addEventListener("click", async () => {
  const told = await end("save");
  if (told) copy(told.command, "The command");
});
byId("yaml").addEventListener("click", async () => {
  const told = await end("save");
  if (told) copy(told.settings, "The YAML file");
});
byId("start").addEventListener("click", async () => {
  if (session.correcting) return correct();
  const told = await end("start");
  if (!told) return;
  byId("told").textContent = told.command;
  watch();
});

// ---- the run, once it has started ----

function watch() {
  document.querySelector("h1").textContent = "The run";
  for (const part of document.querySelectorAll("aside > *")) {
    part.hidden = !["source", "status", "progress", "run", "told"].includes(part.id) && part.tagName !== "H1";
  }
  byId("told").hidden = !byId("told").textContent;
  byId("time").hidden = true;
  resize();
  canvas.style.pointerEvents = "none";
  veils = [];
  follow();
}

const loaded = async (address) => {
  const image = Object.assign(new Image(), { src: address });
  await image.decode();
  return image;
};

// The latest frame with the masks of its objects.
async function showLatest(told) {
  try {
    const [image, ...masks] = await Promise.all([`frame/${told.frame}.jpg`, ...told.veils].map(loaded));
    [picture, veils, frame] = [image, masks, told.frame];
    draw();
  } catch {
    // the next one will do
  }
}

function link(address, text) {
  const line = document.createElement("div");
  line.append(Object.assign(document.createElement("a"), { href: address, target: "_blank", textContent: text }));
  return line;
}

function showRun(told) {
  if (told.frame !== null) showLatest(told);
  byId("stop").hidden = !told.running;
  byId("viewer").hidden = viewer || !told.viewer || (told.running && told.frame === null);
  const name = (number) => (told.reports.length > 1 ? `Report of ${objects[number]?.name ?? number}` : "Report");
  byId("links").replaceChildren(...told.reports.map((address, number) => link(address, name(number))),
    ...(viewer ? [link(viewer, "Viewer")] : []));
  setTimeout(follow, told.running ? 1000 : 20000); // to say that the page is still open
}

byId("stop").addEventListener("click", async () => {
  stopped = byId("stop").disabled = true;
  await ask("stop", {}).catch(() => null);
});
byId("viewer").addEventListener("click", async () => {
  byId("viewer").disabled = true;
  try {
    viewer = new URL((await ask("view", {})).address);
    viewer.hostname = location.hostname; // the browser may know this machine by another name
    byId("links").append(link(viewer, "Viewer"));
    byId("viewer").hidden = true;
  } catch (error) {
    say(error.message, true);
  }
});

// ---- a run that is there is corrected ----

function offerCorrection() {
  document.title = `tracking3d correct ${session.correcting}`;
  document.querySelector("h1").textContent = "Mark the object in this frame";
  for (const id of ["objects", "objects-title", "add", "save", "yaml"]) byId(id).hidden = true;
  byId("start").textContent = "Correct the run";
  follow();
}

// Paint and erase start from the mask that the run has.
async function showPresent() {
  const asks = frame;
  let image = null;
  present = null;
  try {
    const { veil } = await ask("mask", plain({ ...newObject(), colour: COLOURS[0] }));
    image = new Image();
    image.src = veil;
    await image.decode();
  } catch {
    image = null; // the run has no mask of this frame
  }
  if (asks !== frame) return;
  present = image;
  if (isEmpty(one()) && !byId("status").textContent) say(present ? PRESENT : "The run has no mask of this frame.");
  draw();
}

async function follow() {
  let told;
  try {
    told = await (await fetch("progress.json")).json();
  } catch {
    if (session.correcting) return say("The viewer was closed; its unfinished correction was stopped.", true);
    byId("run").hidden = byId("progress").hidden = true;
    return say(stopped ? "The run was stopped. Repeat tracking3d pick, or add --resume to the command below, and it goes on from there."
      : "The program has ended; see the terminal.", !stopped);
  }
  if (!veils) byId("start").disabled = told.running || isEmpty(one());
  if (told.sentence) say(told.sentence, told.failed);
  if (!veils && running && !told.running && !told.failed) {
    objects = [newObject()]; // the drawing is in the run now
    showPresent();
    list();
  }
  running = told.running;
  byId("progress").hidden = !told.running;
  if (told.share === null) byId("progress").removeAttribute("value");
  else byId("progress").value = told.share;
  if (veils) return showRun(told);
  if (told.running) setTimeout(follow, 700);
}

async function correct() {
  byId("start").disabled = true;
  say("One moment …");
  try {
    await ask("correct", plain(one()));
  } catch (error) {
    byId("start").disabled = false;
    return say(error.message, true);
  }
  follow();
}

async function open() {
  session = await (await fetch("session.json")).json();
  byId("source").textContent = `${session.source}, ${session.width} x ${session.height}, tracker ${session.tracker}`;
  frame = session.first;
  for (const id of ["frame", "number"]) {
    Object.assign(byId(id), { min: session.first, max: session.last, step: session.step, value: frame });
  }
  objects = [newObject()];
  take("box");
  resize();
  goTo(Number(/^#frame=(\d{1,9})$/.exec(location.hash)?.[1] ?? frame));
  window.addEventListener("resize", resize);
  if (session.started) watch();
  else if (session.correcting) offerCorrection();
  else if (session.choices) offerSettings();
}

open();
