"use strict";

// Point clouds on a 2D canvas: parallel projection, far points first and paler. No WebGL, so that it draws everywhere.
// A pair's panes share one camera: { up: axis, turn: 3x3 row by row, zoom, at: what is in the middle, from the frame's centre }.

const SLICES = 24; // of depth; points of one slice and colour are drawn as one path
const STEP = Math.PI / 18; // of an arrow key
const PAN_STEP = 30; // pixels
const MARGIN = 0.93; // of a canvas that the clouds fill at first
const ZOOM = { least: 0.4, most: 50, key: 1.2, wheel: 0.0015 };

/** Read base64. */
function bytes(text) {
  return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
}

/** Read what `gallery.quantise` wrote: base64 of little-endian int16, three to a point. */
function points(text, scale) {
  const view = new DataView(bytes(text).buffer);
  return Float32Array.from({ length: view.byteLength / 2 }, (_, i) => view.getInt16(2 * i, true) * scale);
}

/** Read base64 of little-endian float32. */
function floats(text) {
  const view = new DataView(bytes(text).buffer);
  return Float32Array.from({ length: view.byteLength / 4 }, (_, i) => view.getFloat32(4 * i, true));
}

/** Move points by a pose: nine numbers of R row by row, three of t. */
function moved(cloud, pose) {
  const result = new Float32Array(cloud.length);
  for (let i = 0; i < cloud.length; i += 3) {
    for (let row = 0; row < 3; row++) {
      const k = 3 * row;
      result[i + row] = pose[k] * cloud[i] + pose[k + 1] * cloud[i + 1] + pose[k + 2] * cloud[i + 2] + pose[9 + row];
    }
  }
  return result;
}

/** Return the middle of the clouds' bounding box, the radius of a ball around it that holds them, and how far they reach on a screen. */
function bounds(view, ...clouds) {
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  for (const cloud of clouds) {
    cloud.forEach((value, i) => {
      low[i % 3] = Math.min(low[i % 3], value);
      high[i % 3] = Math.max(high[i % 3], value);
    });
  }
  const centre = low.map((value, axis) => (value + high[axis]) / 2);
  const project = projector(view.turn, centre, 1, 0, 0);
  let [across, upright, square] = [0, 0, 0];
  for (const seen of clouds.map(project)) {
    for (let i = 0; i < seen.length; i += 3) {
      across = Math.max(across, Math.abs(seen[i]));
      upright = Math.max(upright, Math.abs(seen[i + 1]));
      square = Math.max(square, seen[i] ** 2 + seen[i + 1] ** 2 + seen[i + 2] ** 2);
    }
  }
  return { centre, radius: Math.sqrt(square) || 1, across: across || 1, upright: upright || 1 };
}

/** Look from the side and a little from above. */
function camera(up = "z") {
  const azimuth = (-58 * Math.PI) / 180;
  const elevation = (18 * Math.PI) / 180;
  const [ca, sa, ce, se] = [Math.cos(azimuth), Math.sin(azimuth), Math.cos(elevation), Math.sin(elevation)];
  const turn = [-sa, ca, 0, -se * ca, -se * sa, ce, ce * ca, ce * sa, se]; // with z up
  const first = "zyx".indexOf(up); // the axes take each other's places in turn
  return { up, turn: turn.map((_, i) => turn[i - (i % 3) + ((i + first) % 3)]), zoom: 1, at: [0, 0, 0] };
}

/** Turn what is seen about the screen's vertical axis, then about its horizontal one, by angles in radians. */
function rotate(view, about_vertical, about_horizontal) {
  const [cv, sv, ch, sh] = [Math.cos(about_vertical), Math.sin(about_vertical), Math.cos(about_horizontal), Math.sin(about_horizontal)];
  const first = [cv, 0, sv, 0, 1, 0, -sv, 0, cv];
  const second = [1, 0, 0, 0, ch, -sh, 0, sh, ch];
  view.turn = product(second, product(first, view.turn));
}

function product(a, b) {
  return a.map((_, i) => [0, 1, 2].reduce((sum, k) => sum + a[3 * Math.floor(i / 3) + k] * b[3 * k + (i % 3)], 0));
}

function zoom(view, factor) {
  view.zoom = Math.min(ZOOM.most, Math.max(ZOOM.least, view.zoom * factor));
}

/** Move what is seen by pixels of the last drawing. */
function pan(view, right, down) {
  view.at = view.at.map((value, axis) => value - (view.turn[axis] * right - view.turn[3 + axis] * down) / view.scale);
}

/**
 * Draw a scene.
 * scene: { frame: of bounds(), clouds: [{ points, colours, shades, hollow }], dots: [{ points, colour }], lines: [{ from, to, colour, dashed, thin }] }
 * A cloud has one colour, or its shades say for each point which of its colours it has.
 */
function draw(canvas, view, scene) {
  const context = canvas.getContext("2d");
  const dense = window.devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  canvas.width = Math.round(width * dense);
  canvas.height = Math.round(height * dense);
  context.scale(dense, dense);
  const { centre, radius, across, upright } = scene.frame;
  const scale = 0.5 * MARGIN * Math.min(width / across, height / upright) * view.zoom;
  view.scale = scale;
  const project = projector(view.turn, centre.map((value, axis) => value + view.at[axis]), scale, width, height);
  const total = scene.clouds.reduce((sum, cloud) => sum + cloud.points.length / 3, 0);
  const size = Math.max(0.8, Math.min(2.2, 0.11 * Math.sqrt((width * height) / total))) * Math.sqrt(view.zoom);
  drawClouds(context, scene.clouds.map((cloud) => ({ ...cloud, seen: project(cloud.points) })), scale * radius, size);
  drawLines(context, scene.lines.map((line) => ({ ...line, from: project(line.from), to: project(line.to) })));
  for (const dots of scene.dots) drawDots(context, project(dots.points), dots.colour, size + 1.3);
}

function projector(turn, centre, scale, width, height) {
  return (cloud) => {
    const seen = new Float32Array(cloud.length);
    for (let i = 0; i < cloud.length; i += 3) {
      const [x, y, z] = [cloud[i] - centre[0], cloud[i + 1] - centre[1], cloud[i + 2] - centre[2]];
      seen[i] = width / 2 + scale * (turn[0] * x + turn[1] * y + turn[2] * z);
      seen[i + 1] = height / 2 - scale * (turn[3] * x + turn[4] * y + turn[5] * z);
      seen[i + 2] = scale * (turn[6] * x + turn[7] * y + turn[8] * z);
    }
    return seen;
  };
}

function drawClouds(context, clouds, reach, size) {
  const sliced = clouds.map((cloud) => ({ ...cloud, slices: slices(cloud.seen, reach) }));
  for (let slice = 0; slice < SLICES; slice++) {
    context.globalAlpha = 0.4 + (0.6 * slice) / (SLICES - 1);
    for (const { seen, slices, colours, shades, hollow } of slice % 2 ? sliced : [...sliced].reverse()) { // neither cloud hides the other
      colours.forEach((colour, shade) => {
        context.beginPath();
        for (const i of slices[slice]) {
          if (!shades || shades[i / 3] === shade) disc(context, seen[i], seen[i + 1], hollow ? size + 0.8 : size);
        }
        context.fillStyle = context.strokeStyle = colour;
        context.lineWidth = 0.9;
        hollow ? context.stroke() : context.fill();
      });
    }
  }
  context.globalAlpha = 1;
}

/** Sort points by depth, the farthest slice first: for each slice, where its points start in `seen`. */
function slices(seen, reach) {
  const sorted = Array.from({ length: SLICES }, () => []);
  for (let i = 0; i < seen.length; i += 3) {
    const slice = Math.floor(((seen[i + 2] / reach + 1) / 2) * SLICES);
    sorted[Math.max(0, Math.min(SLICES - 1, slice))].push(i);
  }
  return sorted;
}

function drawLines(context, lines) {
  for (const { from, to, colour, dashed, thin } of lines) {
    context.lineWidth = thin ? 0.7 : 1.1;
    context.globalAlpha = thin ? 0.6 : 0.8;
    context.setLineDash(dashed ? [5, 3] : []);
    context.beginPath();
    for (let i = 0; i < from.length; i += 3) {
      context.moveTo(from[i], from[i + 1]);
      context.lineTo(to[i], to[i + 1]);
    }
    context.strokeStyle = colour;
    context.stroke();
    for (const ends of [from, to]) drawDots(context, ends, colour, thin ? 1 : 1.8);
  }
  context.globalAlpha = 1;
}

function drawDots(context, seen, colour, size) {
  context.beginPath();
  for (let i = 0; i < seen.length; i += 3) disc(context, seen[i], seen[i + 1], size);
  context.fillStyle = colour;
  context.fill();
}

function disc(context, x, y, size) {
  if (size < 1) {
    context.rect(x - size, y - size, 2 * size, 2 * size); // looks the same, and takes a fraction of the time
    return;
  }
  context.moveTo(x + size, y);
  context.arc(x, y, size, 0, 2 * Math.PI);
}

/**
 * Let a canvas be turned, moved and zoomed by mouse, touch and keys; `changed` is called after each change of the view.
 * The wheel zooms a view that was clicked, so that a page of many views still scrolls; or any, if it is `alone` on its page.
 */
function steer(canvas, view, changed, alone = false) {
  const held = new Map(); // pointers that are down
  const apart = () => {
    const [a, b] = [...held.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    held.set(event.pointerId, { x: event.clientX, y: event.clientY });
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = held.get(event.pointerId);
    if (!last) return;
    const before = held.size === 2 ? apart() : 0;
    held.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const [right, down] = [event.clientX - last.x, event.clientY - last.y];
    if (held.size === 2) {
      zoom(view, apart() / Math.max(1, before));
      pan(view, right / 2, down / 2); // as far as the middle between both fingers
    } else if (event.shiftKey || event.buttons & 6) pan(view, right, down);
    else rotate(view, (right * Math.PI) / 250, (down * Math.PI) / 250);
    changed();
  });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault()); // the right button moves the view
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => held.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => {
    if (!alone && document.activeElement !== canvas && !event.ctrlKey) return; // a pinch on a touchpad comes with ctrl
    event.preventDefault();
    zoom(view, Math.exp(-event.deltaY * ZOOM.wheel * (event.ctrlKey ? 5 : 1)));
    changed();
  }, { passive: false });
  const keys = {
    ArrowLeft: () => rotate(view, -STEP, 0),
    ArrowRight: () => rotate(view, STEP, 0),
    ArrowUp: () => rotate(view, 0, -STEP),
    ArrowDown: () => rotate(view, 0, STEP),
    "+": () => zoom(view, ZOOM.key),
    "=": () => zoom(view, ZOOM.key),
    "-": () => zoom(view, 1 / ZOOM.key),
    0: () => Object.assign(view, camera(view.up)),
  };
  const moves = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  canvas.addEventListener("keydown", (event) => {
    if (!Object.hasOwn(keys, event.key) || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    if (event.shiftKey && moves[event.key]) pan(view, ...moves[event.key].map((step) => PAN_STEP * step));
    else keys[event.key]();
    changed();
  });
}

// What the controls of both pages need.

function control(id) {
  return document.getElementById(id);
}

/** Return colours of the page by their names; they differ between the light and the dark scheme. */
function colours(...names) {
  const style = getComputedStyle(document.documentElement);
  return Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

/** Show the entries of the key that belong to a ticked control. */
function showKey() {
  for (const entry of document.querySelectorAll("[data-with]")) entry.hidden = !control(entry.dataset.with).checked;
}
