// The slider and what hangs on it: picture, words, plots, model. What is shown comes from the JSON in the page.
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const byId = (id) => document.getElementById(id);
  const slider = byId("slider");
  const viewer = data.model ? showModel(byId("model"), data.model) : null;
  if (viewer) setUpModel();
  if (!slider) return;

  const cursors = [...document.querySelectorAll("svg .cursor")];
  const count = data.indices.length;
  let playing = null;

  const position = () => Number(slider.value);
  const statusOf = (at) => ({ t: "tracked", u: "uncertain", l: "lost" })[data.statuses[at]];

  // The last picture that is not of a later frame.
  function pictureOf(at) {
    let low = 0, high = data.pictured.length - 1;
    while (low < high) {
      const middle = Math.ceil((low + high) / 2);
      if (data.pictured[middle] <= at) low = middle; else high = middle - 1;
    }
    return low;
  }

  function show() {
    const at = position(), status = statusOf(at), x = 1000 * (at + 0.5) / count;
    for (const line of cursors) { line.setAttribute("x1", x); line.setAttribute("x2", x); }
    const words = [`${status}, confidence ${data.confidences[at] ?? "unknown"}`];
    if (data.keyframes.includes(at)) words.push("keyframe");
    if (data.times) words.push(`${data.times[at]} s`);
    if (data.pictured.length) {
      const picture = pictureOf(at);
      byId("picture").src = "data:image/jpeg;base64," + data.pictures[picture];
      byId("picture").alt = `Frame ${data.indices[data.pictured[picture]]} with the estimated outline and pose`;
      const none = showProbability(picture);
      if (none) words.push(none);
      if (data.pictured[picture] !== at) words.push(`picture of frame ${data.indices[data.pictured[picture]]}`);
    }
    const said = byId("said"), strong = document.createElement("span");
    strong.className = "status " + status;
    strong.textContent = `Frame ${data.indices[at]}: `;
    said.replaceChildren(strong, words.join(", "));
    const reason = data.reasons[data.reason[at]];
    if (reason) said.append(document.createElement("br"), reason);
    slider.setAttribute("aria-valuetext", `frame ${data.indices[at]}, ${status}`);
    if (viewer) viewer.showAs(data.rotations[data.pictured.length ? pictureOf(at) : 0]);
  }

  // Why there is none to be shown, if one was asked for.
  function showProbability(picture) {
    const layer = byId("probability");
    if (!layer) return "";
    const asked = byId("likely").getAttribute("aria-pressed") === "true", found = data.probabilities[picture];
    layer.hidden = !(asked && found);
    byId("ramp").hidden = !asked;
    if (!layer.hidden) layer.src = "data:image/png;base64," + found;
    return asked && !found ? "no probability, the mask was not fused" : "";
  }

  function go(to) {
    slider.value = Math.min(Math.max(to, 0), count - 1);
    show();
  }

  // Jump targets: frames at which the status or reason changes to anything but tracked.
  function doubt(direction) {
    const begins = data.doubts.filter((at) => direction > 0 ? at > position() : at < position());
    if (begins.length) go(direction > 0 ? begins[0] : begins[begins.length - 1]);
  }

  function pause() {
    clearInterval(playing);
    playing = null;
    byId("play").textContent = "Play";
    byId("play").setAttribute("aria-pressed", "false");
  }

  function play() {
    if (position() === count - 1) go(0);
    byId("play").textContent = "Pause";
    byId("play").setAttribute("aria-pressed", "true");
    playing = setInterval(() => { position() < count - 1 ? go(position() + 1) : pause(); }, 1000 / data.speed);
  }

  slider.addEventListener("input", () => { pause(); show(); });
  byId("play").addEventListener("click", () => playing ? pause() : play());
  byId("before").addEventListener("click", () => { pause(); doubt(-1); });
  byId("after").addEventListener("click", () => { pause(); doubt(1); });
  byId("likely")?.addEventListener("click", (event) => {
    const pressed = event.currentTarget.getAttribute("aria-pressed") === "true";
    event.currentTarget.setAttribute("aria-pressed", String(!pressed));
    show();
  });
  byId("before").disabled = byId("after").disabled = !data.doubts.length;

  for (const plot of document.querySelectorAll("[data-plot] svg")) {
    const jump = (event) => {
      const box = plot.getBoundingClientRect();
      pause();
      go(Math.floor(count * (event.clientX - box.left) / box.width));
    };
    plot.addEventListener("click", jump);
    plot.addEventListener("pointermove", (event) => { if (event.buttons && event.pointerType === "mouse") jump(event); });
  }
  for (const button of document.querySelectorAll("[data-position]")) {
    button.addEventListener("click", () => {
      pause();
      go(Number(button.dataset.position));
      const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
      document.querySelector(".stage").scrollIntoView({ behavior: calm ? "auto" : "smooth" });
    });
  }

  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("input, canvas, summary, .sheet")) return;
    const steps = { ArrowLeft: -1, ArrowRight: 1 };
    if (event.key in steps) { pause(); go(position() + steps[event.key]); event.preventDefault(); }
  });
  show();

  function setUpModel() {
    byId("still").hidden = true;
    byId("model").hidden = byId("model-buttons").hidden = false;
    const follow = byId("follow"), spin = byId("spin");
    const said = () => {
      follow.setAttribute("aria-pressed", String(viewer.following));
      spin.setAttribute("aria-pressed", String(viewer.spinning));
    };
    viewer.onchange = said;
    follow.addEventListener("click", () => viewer.follow(!viewer.following));
    spin.addEventListener("click", () => viewer.spin(!viewer.spinning));
    viewer.showAs(data.rotations[0]);
    said();
  }
})();
