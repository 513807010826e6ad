// A textured mesh to turn, in WebGL 2 and nothing else. Rotations are 3 x 3, row by row, object to camera with OpenCV's
// axes: x right, y down, z forward. The texture's picture holds colours above and, below, what was ever seen.
"use strict";
function showModel(canvas, model) {
  const gl = canvas.getContext("webgl2", { antialias: true, alpha: false });
  if (!gl) return null;
  const DISTANCE = 4;
  const vertexSource = `#version 300 es
    in vec3 position; in vec3 normal; in vec2 coordinate;
    uniform mat3 turn; uniform vec3 lens;
    out vec3 facing; out vec3 place; out vec2 texel;
    void main() {
      place = turn * position + vec3(0.0, 0.0, ${DISTANCE}.0);
      facing = turn * normal;
      texel = coordinate;
      gl_Position = vec4(lens.x * place.x, -lens.y * place.y, (place.z - lens.z) * 0.5, place.z);
    }`;
  const fragmentSource = `#version 300 es
    precision highp float;
    in vec3 facing; in vec3 place; in vec2 texel;
    uniform sampler2D surface; uniform vec3 pale;
    out vec4 colour;
    void main() {
      float inset = 0.5 / float(textureSize(surface, 0).y);
      float v = clamp(texel.y * 0.5, inset, 0.5 - inset);
      vec3 seen = texture(surface, vec2(texel.x, v)).rgb;
      float known = smoothstep(0.35, 0.65, texture(surface, vec2(texel.x, v + 0.5)).r);
      float light = max(dot(normalize(facing), normalize(-place)), 0.0);
      colour = vec4(mix(pale * (0.75 + 0.25 * light), seen * (0.45 + 0.55 * light), known), 1.0);
    }`;

  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertexSource], [gl.FRAGMENT_SHADER, fragmentSource]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return null;
  gl.useProgram(program);
  const uniform = (name) => gl.getUniformLocation(program, name);
  const places = { turn: uniform("turn"), lens: uniform("lens"), pale: uniform("pale") };

  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
  for (const [name, text, size] of [
    ["position", model.positions, 3], ["normal", model.normals, 3], ["coordinate", model.coordinates, 2],
  ]) {
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(bytes(text)), gl.STATIC_DRAW);
    const place = gl.getAttribLocation(program, name);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, size, gl.FLOAT, false, 0, 0);
  }
  const faces = new Uint32Array(bytes(model.faces));
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array([150, 150, 150, 255]));
  gl.enable(gl.DEPTH_TEST);

  let rotation = [1, 0, 0, 0, 1, 0, 0, 0, 1], shown = rotation, known = true, scale = 1, drawn = 0;
  const view = { following: true, spinning: false, onchange: () => {} };

  const product = (a, b) => [0, 1, 2].flatMap((r) => [0, 1, 2].map((c) =>
    a[3 * r] * b[c] + a[3 * r + 1] * b[3 + c] + a[3 * r + 2] * b[6 + c]));
  const about = {
    x: (angle) => [1, 0, 0, 0, Math.cos(angle), -Math.sin(angle), 0, Math.sin(angle), Math.cos(angle)],
    y: (angle) => [Math.cos(angle), 0, Math.sin(angle), 0, 1, 0, -Math.sin(angle), 0, Math.cos(angle)],
  };

  const resolve = document.createElement("canvas").getContext("2d");
  function colourOf(name) {
    resolve.fillStyle = getComputedStyle(document.documentElement).getPropertyValue(name).trim();
    const number = parseInt(resolve.fillStyle.slice(1), 16);
    return [16, 8, 0].map((shift) => ((number >> shift) & 255) / 255);
  }

  function draw() {
    drawn = 0;
    canvas.classList.toggle("unknown", view.following && !known);
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (!width || !height) return;
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    gl.viewport(0, 0, width, height);
    gl.clearColor(...colourOf("--stage"), 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const focal = 0.86 * Math.sqrt(DISTANCE * DISTANCE - 1) * scale, side = Math.min(width, height);
    gl.uniformMatrix3fv(places.turn, true, rotation);
    gl.uniform3f(places.lens, focal * side / width, focal * side / height, DISTANCE);
    gl.uniform3f(places.pale, ...colourOf("--pale"));
    gl.drawElements(gl.TRIANGLES, faces.length, gl.UNSIGNED_INT, 0);
  }
  const later = () => { if (!drawn) drawn = requestAnimationFrame(draw); };

  function turn(right, down) {
    view.following = false;
    rotation = product(about.x(down), product(about.y(-right), rotation));
    view.onchange();
    later();
  }
  function zoom(factor) {
    scale = Math.min(Math.max(scale * factor, 0.5), 6);
    later();
  }

  // Where the pose of a frame is not known, the last one stays and is dimmed.
  view.showAs = (other) => {
    known = Boolean(other);
    shown = other || shown;
    if (view.following) { rotation = shown; later(); }
  };
  view.follow = (on) => {
    view.following = on;
    view.spinning &&= !on;
    if (on) { rotation = shown; scale = 1; }
    view.onchange();
    later();
  };
  view.spin = (on) => {
    view.spinning = on;
    let before = performance.now();
    const step = (now) => {
      if (!view.spinning) return;
      turn((now - before) / 1400, 0);
      before = now;
      requestAnimationFrame(step);
    };
    if (on) requestAnimationFrame(step);
    view.onchange();
  };

  const fingers = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    fingers.set(event.pointerId, event);
    canvas.setPointerCapture(event.pointerId);
    canvas.classList.add("held");
    view.spinning = false;
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const others = [...fingers.values()].filter((one) => one.pointerId !== event.pointerId);
    if (others.length) {
      const apart = (one) => Math.hypot(one.clientX - others[0].clientX, one.clientY - others[0].clientY) + 1;
      zoom(apart(event) / apart(before));
    } else {
      turn((event.clientX - before.clientX) / 120, (event.clientY - before.clientY) / 120);
    }
    fingers.set(event.pointerId, event);
  });
  for (const end of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(end, (event) => {
      fingers.delete(event.pointerId);
      if (!fingers.size) canvas.classList.remove("held");
    });
  }
  // A wheel scrolls the page; over a model that was clicked on, it zooms.
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas) return;
    event.preventDefault();
    zoom(Math.exp(-event.deltaY / 600));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const step = 0.12;
    const acts = {
      ArrowLeft: () => turn(-step, 0), ArrowRight: () => turn(step, 0),
      ArrowUp: () => turn(0, -step), ArrowDown: () => turn(0, step),
      "+": () => zoom(1.15), "=": () => zoom(1.15), "-": () => zoom(1 / 1.15),
    };
    if (event.ctrlKey || event.metaKey || event.altKey || !(event.key in acts)) return;
    view.spinning = false;
    acts[event.key]();
    event.preventDefault();
  });

  const picture = new Image();
  picture.addEventListener("load", () => {
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, picture);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.REPEAT);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    later();
  });
  picture.src = model.texture;
  new ResizeObserver(later).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", later);
  return view;
}
