// The pairs of the page and its controls.

const data = JSON.parse(control("data").textContent);
const visible = new Set();
let waiting = false;

const cards = [...document.querySelectorAll(".pair")].map((element, i) => card(element, data.pairs[i]));

/** Prepare the card of a pair: its arrays, its two canvases, and a function that draws them as the controls say. */
function card(element, stored) {
  const { scale, truth, poses } = stored;
  const [source, target] = [points(stored.source, scale), points(stored.target, scale)];
  const matches = stored.matches && readMatches(stored.matches, scale);
  const view = camera();
  const frame = bounds(view, source, target, moved(source, truth));
  const canvases = [...element.querySelectorAll("canvas")];
  const caption = canvases[1].parentElement.querySelector("figcaption");
  const rows = [...element.querySelectorAll("[data-method]")];
  const drawAll = () => {
    const shown = controls();
    const colour = colours("source", "target", "right", "wrong", "truth");
    const pose = poses[shown.method];
    for (const row of rows) row.classList.toggle("shown", row.dataset.method === shown.method);
    caption.textContent = `after ${shown.method}`;
    for (const canvas of canvases) {
      const place = canvas.dataset.when === "after" ? (cloud) => moved(cloud, pose) : (cloud) => cloud;
      const scene = { frame, clouds: [], lines: [], dots: [] };
      if (shown.truth && canvas.dataset.when === "after") scene.clouds.push({ points: moved(source, truth), colours: [colour.truth], hollow: true });
      scene.clouds.push({ points: target, colours: [colour.target] }, { points: place(source), colours: [colour.source] });
      if (matches) addMatches(scene, matches, place, shown, colour);
      draw(canvas, view, scene);
    }
  };
  const item = { element, view, drawAll };
  for (const canvas of canvases) steer(canvas, view, () => redraw([item]));
  return item;
}

/** Sort the correspondences that the pose counts into right and wrong ones. */
function readMatches(stored, scale) {
  const [source, target] = [points(stored.source, scale), points(stored.target, scale)];
  const used = stored.chosen.flatMap((_, k) => (stored.used[k] ? [k] : []));
  const pick = (cloud, indices) => Float32Array.from(indices.flatMap((i) => [...cloud.slice(3 * i, 3 * i + 3)]));
  const lines = ["wrong", "right"].map((name) => {
    const chosen = used.filter((k) => Boolean(stored.right[k]) === (name === "right"));
    return { name, from: pick(source, chosen), to: pick(target, chosen.map((k) => stored.chosen[k])) };
  });
  return { source, target, lines };
}

function addMatches(scene, matches, place, shown, colour) {
  if (shown.keypoints) {
    scene.dots.push({ points: matches.target, colour: colour.target }, { points: place(matches.source), colour: colour.source });
  }
  if (shown.correspondences) {
    for (const { name, from, to } of matches.lines) scene.lines.push({ from: place(from), to, colour: colour[name], dashed: name === "wrong" });
  }
}

function controls() {
  const ticked = ["correspondences", "keypoints", "truth"].map((id) => [id, control(id).checked]);
  return { method: control("method").value, ...Object.fromEntries(ticked) };
}

/** Draw cards once before the next frame; those out of sight when they come into it. */
const stale = new Set();
function redraw(items) {
  for (const item of items) stale.add(item);
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => {
    waiting = false;
    for (const item of [...stale].filter((item) => visible.has(item))) {
      stale.delete(item);
      item.drawAll();
    }
  });
}

const sight = new IntersectionObserver(
  (entries) => {
    for (const { target, isIntersecting } of entries) {
      const item = cards.find(({ element }) => element === target);
      isIntersecting ? visible.add(item) : visible.delete(item);
    }
    redraw([...visible].filter((item) => stale.has(item)));
  },
  { rootMargin: "400px" },
);

const anyMatches = data.pairs.some((pair) => pair.matches);
for (const id of ["correspondences", "keypoints"]) {
  control(id).disabled = !anyMatches;
  control(id).checked &&= anyMatches;
}
function changed() {
  showKey();
  redraw(cards);
}
for (const id of ["method", "correspondences", "keypoints", "truth"]) control(id).addEventListener("change", changed);
control("reset").addEventListener("click", () => {
  for (const { view } of cards) Object.assign(view, camera());
  redraw(cards);
});
document.querySelector(".controls").addEventListener("submit", (event) => event.preventDefault());
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => redraw(cards));
window.addEventListener("resize", () => redraw(cards));
window.addEventListener("beforeprint", () => cards.forEach((item) => item.drawAll()));
changed();
for (const { element } of cards) sight.observe(element);
