// The view of one registration and its controls.

const SECONDS = 0.5; // from before to after
const data = JSON.parse(control("data").textContent);
const [source, target] = data.clouds.map(({ points }) => floats(points)); // each from its own centre; the page's frame is the target's
const [from, to] = data.clouds.map(({ matched }) => floats(matched));
const poses = data.poses.map((pose) => ({ ...pose, shades: pose.shades.map(bytes) }));
const canvas = control("view");
const view = camera(data.up);
const cores = [source, target].map((cloud, i) => core(cloud, data.clouds[i].radius));
for (const pose of poses) pose.frames = [0, 1].map((share) => bounds(view, moved(cores[0], placed(pose, share)), cores[1]));

/** Return the points that the view is made to hold: stray ones lie farther out. */
function core(cloud, radius) {
  return cloud.filter((_, i) => Math.hypot(...cloud.subarray(i - (i % 3), i - (i % 3) + 3)) <= radius);
}

/** Return R and t of the source on its way: a share of the turn about its centre, and of the way of that centre. */
function placed({ turn, at }, share) {
  const R = rotationBy(turn.map((value) => share * value));
  return [...R, ...mixed(data.before, at, share)];
}

/** Return the rotation, nine numbers row by row, by a rotation vector in radians. */
function rotationBy([x, y, z]) {
  const angle = Math.hypot(x, y, z);
  const [s, c] = angle > 0 ? [Math.sin(angle) / angle, (1 - Math.cos(angle)) / angle ** 2] : [1, 0.5];
  return [
    1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y,
    c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x,
    c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y),
  ];
}

function mixed(a, b, share) {
  return a.map((value, i) => value + share * (b[i] - value));
}

function frameAt([before, after], share) {
  const keys = ["radius", "across", "upright"];
  const sizes = mixed(keys.map((key) => before[key]), keys.map((key) => after[key]), share);
  return { centre: mixed(before.centre, after.centre, share), ...Object.fromEntries(keys.map((key, i) => [key, sizes[i]])) };
}

/** Return the colours of distances, from 0 to the farthest. */
function scale({ near, middle, far }) {
  const [a, b, c] = [near, middle, far].map((colour) => [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16)));
  return Array.from({ length: data.levels }, (_, level) => {
    const share = (2 * level) / (data.levels - 1);
    const colour = share < 1 ? mixed(a, b, share) : mixed(b, c, share - 1);
    return `rgb(${colour.map(Math.round).join(" ")})`;
  });
}

function drawAll() {
  const share = Number(control("share").value);
  const pose = poses[control("pose").value];
  const place = placed(pose, share);
  const colour = colours("source", "target", "ink", "near", "middle", "far");
  const scene = { frame: frameAt(pose.frames, share), clouds: [], lines: [], dots: [] };
  for (const [i, name, cloud] of [[0, "source", moved(source, place)], [1, "target", target]]) {
    if (!control(name).checked) continue;
    const coloured = control("distance").checked ? { colours: scale(colour), shades: pose.shades[i] } : { colours: [colour[name]] };
    scene.clouds.push({ points: cloud, ...coloured });
  }
  if (control("matches").checked) scene.lines.push({ from: moved(from, place), to, colour: colour.ink, thin: true });
  draw(canvas, view, scene);
}

let waiting = false;
function redraw() {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => {
    waiting = false;
    drawAll();
  });
}

/** Bring the texts up to date with the controls, and draw. */
function changed() {
  const [share, chosen] = [Number(control("share").value), Number(control("pose").value)];
  const when = share === 0 ? "before" : share === 1 ? "after" : "on the way";
  const name = poses.length > 1 ? control("pose").selectedOptions[0].text : "";
  control("shown").textContent = name ? `${when}, ${name}` : when;
  control("of").textContent = name.split(":")[0];
  control("before").setAttribute("aria-pressed", share === 0);
  control("after").setAttribute("aria-pressed", share === 1);
  control("matches").disabled = chosen > 0 || from.length === 0; // they belong to the best pose
  if (control("matches").disabled) control("matches").checked = false;
  for (const matrix of document.querySelectorAll("[data-pose]")) matrix.hidden = Number(matrix.dataset.pose) !== chosen;
  showKey();
  redraw();
}

let sliding = 0;
/** Slide to before (0) or after (1). */
function slide(to) {
  const start = performance.now();
  const from = Number(control("share").value);
  const quick = matchMedia("(prefers-reduced-motion: reduce)").matches;
  cancelAnimationFrame(sliding);
  const step = (now) => {
    const done = quick ? 1 : Math.min(1, (now - start) / (1000 * SECONDS));
    control("share").value = from + done * (to - from);
    changed();
    if (done < 1) sliding = requestAnimationFrame(step);
  };
  step(start);
}

/** Copy the matrix that is shown, with all digits; where a browser forbids it, select it. */
async function copy() {
  const matrix = document.querySelector("[data-pose]:not([hidden])");
  try {
    await navigator.clipboard.writeText(matrix.dataset.full);
    control("copy").textContent = "copied";
  } catch {
    matrix.textContent = matrix.dataset.full;
    getSelection().selectAllChildren(matrix);
    control("copy").textContent = "selected";
  }
  setTimeout(() => (control("copy").textContent = "copy"), 1500);
}

steer(canvas, view, redraw, true);
canvas.addEventListener("keydown", (event) => {
  if (event.key !== " ") return;
  event.preventDefault();
  slide(Number(control("share").value) > 0.5 ? 0 : 1);
});
for (const id of ["pose", "source", "target", "matches", "distance"]) control(id).addEventListener("change", changed);
control("share").addEventListener("input", () => {
  cancelAnimationFrame(sliding);
  changed();
});
control("before").addEventListener("click", () => slide(0));
control("after").addEventListener("click", () => slide(1));
control("copy").addEventListener("click", copy);
control("reset").addEventListener("click", () => {
  Object.assign(view, camera(data.up));
  redraw();
});
document.querySelector(".controls").addEventListener("submit", (event) => event.preventDefault());
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
window.addEventListener("resize", redraw);
window.addEventListener("beforeprint", drawAll);
changed();
