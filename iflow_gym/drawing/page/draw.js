// The sheet, the pen, the fit, the points. Lengths are millimetres, y upwards; times are seconds.
"use strict";

const HALF = 50; // the sheet is [-HALF, HALF] both ways
const REACH = 14; // pixels within which a press takes a point
const ARRIVED = 1; // a point this near to the goal is there
const RESTS = 0.02; // a path that moves less in its last half second is at rest
const MOST_POINTS = 150;
const MOST_TRAIL = 1000; // samples, of 4 ms
const MOST_STROKES = 30;
const POLL = 150; // ms

let methods = []; // that the server offers, when it has them

const $ = (id) => document.getElementById(id);
const surface = $("surface");
const still = matchMedia("(prefers-reduced-motion: reduce)");

const page = {
  strokes: [], // of samples [t, x, y]
  past: [], // what `strokes` was before each change
  pen: null, // the stroke being drawn: {pointer, samples}
  fit: null, // {id, version, demonstrations, goal, period, field, running}
  asked: 0, // counts the fits that were asked for
  changed: false, // whether the strokes are other than those of the fit
  points: [],
  held: null, // the point that the pointer holds
  cross: { x: 0, y: 0, shown: false },
  nextPoint: 1,
};

const chosen = (name) => document.querySelector(`input[name=${name}]:checked`).value;
const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);
const mm = (v) => (Math.abs(v) < 0.05 ? "0.0" : v.toFixed(1));
const plural = (n, word) => `${n} ${word}${n === 1 ? "" : "s"}`;

function say(text) {
  $("said").textContent = text;
}

function complain(text) {
  $("wrong").hidden = !text;
  $("wrong").textContent = text;
  if (text) say("");
}

async function ask(path, body) {
  const options = body === undefined ? {} : {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify(body),
  };
  let response;
  try {
    response = await fetch(`api/${path}`, options);
  } catch {
    throw new Error("The server does not answer: is it still running? Start it again, and reload.");
  }
  const answer = await response.json().catch(() => ({}));
  if (!response.ok) throw new Error(answer.error || `The server failed (${response.status}).`);
  return answer;
}

// Colours and coordinates -----------------------------------------------------------------------

let colours = {};

function readColours() {
  const style = getComputedStyle(document.documentElement);
  for (const name of ["ink", "soft", "card", "grid", "stroke", "point", "goal", "goal-edge", "slow", "fast"]) {
    colours[name] = style.getPropertyValue(`--${name}`).trim();
  }
}

function mixed(from, to, share) {
  const parts = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));
  const [a, b] = [parts(from), parts(to)];
  return `rgb(${a.map((v, i) => Math.round(v + (b[i] - v) * share)).join(",")})`;
}

// Make a canvas as fine as the screen; return what draws on it in millimetres.
function brushOf(canvas) {
  const size = Math.max(1, Math.round(canvas.clientWidth * (window.devicePixelRatio || 1)));
  if (canvas.width !== size || canvas.height !== size) canvas.width = canvas.height = size;
  const brush = canvas.getContext("2d");
  const scale = size / (2 * HALF);
  brush.setTransform(scale, 0, 0, -scale, size / 2, size / 2);
  brush.clearRect(-HALF, -HALF, 2 * HALF, 2 * HALF);
  brush.lineCap = brush.lineJoin = "round";
  return { brush, pixel: (2 * HALF) / Math.max(1, canvas.clientWidth) };
}

function placeOf(event) {
  const box = surface.getBoundingClientRect();
  return [
    ((event.clientX - box.left) / box.width - 0.5) * 2 * HALF,
    (0.5 - (event.clientY - box.top) / box.height) * 2 * HALF,
  ];
}

// Streamlines -----------------------------------------------------------------------------------

// The field between the nodes of the grid, bilinear; null outside, or where it is not finite.
function velocityAt(field, x, y) {
  const { n, half, velocities: v } = field;
  const gx = ((x + half) / (2 * half)) * (n - 1);
  const gy = ((y + half) / (2 * half)) * (n - 1);
  if (!(gx >= 0 && gy >= 0 && gx <= n - 1 && gy <= n - 1)) return null;
  const i = Math.min(Math.floor(gx), n - 2);
  const j = Math.min(Math.floor(gy), n - 2);
  const [a, b] = [gx - i, gy - j];
  const found = [0, 0];
  for (const [di, dj, w] of [[0, 0, (1 - a) * (1 - b)], [1, 0, a * (1 - b)], [0, 1, (1 - a) * b], [1, 1, a * b]]) {
    const at = 2 * ((j + dj) * n + i + di);
    if (v[at] === null || v[at + 1] === null) return null;
    found[0] += w * v[at];
    found[1] += w * v[at + 1];
  }
  return found;
}

// Streamlines about as far apart as a cell of a mask: a line ends where it comes into a cell that
// another one is in.
function streamlines(field) {
  const cells = 34;
  const taken = new Int32Array(cells * cells);
  const cellOf = (x, y) => {
    const i = Math.floor(((x + HALF) / (2 * HALF)) * cells);
    const j = Math.floor(((y + HALF) / (2 * HALF)) * cells);
    return i < 0 || j < 0 || i >= cells || j >= cells ? -1 : j * cells + i;
  };
  const step = 0.4;
  const least = 8; // millimetres of a line
  const lines = [];
  const walk = (x, y, way, number, own) => {
    const line = [];
    for (let k = 0; k < 700; k += 1) {
      const here = velocityAt(field, x, y);
      const speed = here && Math.hypot(...here);
      if (!speed || speed < 1e-9) break;
      const half = velocityAt(field, x + (way * step * here[0]) / speed / 2, y + (way * step * here[1]) / speed / 2);
      const pace = half && Math.hypot(...half);
      if (!pace || pace < 1e-9) break;
      x += (way * step * half[0]) / pace;
      y += (way * step * half[1]) / pace;
      const cell = cellOf(x, y);
      if (cell < 0 || (taken[cell] && taken[cell] !== number)) break;
      if (!taken[cell]) {
        taken[cell] = number;
        own.push(cell);
      } else if (own.length > 3 && own.lastIndexOf(cell) < own.length - 3) {
        break; // round once
      }
      line.push([x, y, speed]);
    }
    return line;
  };
  // From the middle of each cell, in an order that jumps about: 389 has no factor of cells^2.
  for (let k = 0; k < cells * cells; k += 1) {
    const cell = (k * 389) % (cells * cells);
    if (taken[cell]) continue;
    const x = (((cell % cells) + 0.5) / cells - 0.5) * 2 * HALF;
    const y = ((Math.floor(cell / cells) + 0.5) / cells - 0.5) * 2 * HALF;
    const number = lines.length + 1;
    const here = velocityAt(field, x, y);
    if (!here) continue;
    const own = [cell];
    taken[cell] = number;
    const ahead = walk(x, y, 1, number, own);
    const behind = walk(x, y, -1, number, own.slice(0, 1));
    const line = [...behind.reverse(), [x, y, Math.hypot(...here)], ...ahead];
    if (line.length * step >= least) {
      lines.push(line);
    } else {
      for (let c = 0; c < taken.length; c += 1) if (taken[c] === number) taken[c] = 0;
    }
  }
  return lines;
}

function drawField() {
  const { brush, pixel } = brushOf($("field"));
  brush.strokeStyle = colours.grid;
  brush.lineWidth = pixel;
  brush.beginPath();
  for (let v = -40; v <= 40; v += 10) {
    brush.moveTo(v, -HALF);
    brush.lineTo(v, HALF);
    brush.moveTo(-HALF, v);
    brush.lineTo(HALF, v);
  }
  brush.stroke();
  const field = page.fit && page.fit.field;
  $("field").dataset.lines = "0";
  if (!field) return;
  field.lines = field.lines || streamlines(field);
  const speeds = field.lines.flatMap((line) => line.map((p) => p[2])).sort((a, b) => a - b);
  const typical = speeds[Math.floor(speeds.length / 2)] || 1;
  const top = Math.log1p((speeds[Math.floor(speeds.length * 0.98)] || 1) / typical);
  const shade = (speed) => Math.min(1, Math.log1p(speed / typical) / top);
  brush.lineWidth = 1.3 * pixel;
  const piece = 10;
  for (const line of field.lines) {
    for (let k = 0; k < line.length - 1; k += piece) {
      brush.strokeStyle = mixed(colours.slow, colours.fast, shade(line[Math.min(k + piece / 2, line.length - 1)][2]));
      brush.beginPath();
      brush.moveTo(line[k][0], line[k][1]);
      for (let i = k + 1; i <= Math.min(k + piece, line.length - 1); i += 1) brush.lineTo(line[i][0], line[i][1]);
      brush.stroke();
    }
    const middle = Math.floor(line.length / 2);
    const [x, y, speed] = line[middle];
    const [px, py] = line[Math.max(0, middle - 3)];
    const angle = Math.atan2(y - py, x - px);
    const size = 6 * pixel;
    brush.fillStyle = mixed(colours.slow, colours.fast, shade(speed));
    brush.beginPath();
    brush.moveTo(x + size * Math.cos(angle), y + size * Math.sin(angle));
    for (const side of [2.5, -2.5]) {
      brush.lineTo(x + size * 0.8 * Math.cos(angle + side), y + size * 0.8 * Math.sin(angle + side));
    }
    brush.fill();
  }
  $("field").dataset.lines = String(field.lines.length);
}

// The surface: strokes, goal, points ------------------------------------------------------------

function polyline(brush, path, at = 0) {
  brush.beginPath();
  path.forEach((p, i) => (i ? brush.lineTo(p[at], p[at + 1]) : brush.moveTo(p[at], p[at + 1])));
  brush.stroke();
}

function disc(brush, x, y, radius) {
  brush.beginPath();
  brush.arc(x, y, radius, 0, 2 * Math.PI);
}

function star(brush, [x, y], radius) {
  brush.beginPath();
  for (let k = 0; k < 10; k += 1) {
    const r = k % 2 ? 0.42 * radius : radius;
    const angle = Math.PI / 2 + (k * Math.PI) / 5;
    brush.lineTo(x + r * Math.cos(angle), y + r * Math.sin(angle));
  }
  brush.closePath();
}

function drawSurface() {
  const { brush, pixel } = brushOf(surface);
  const fitted = page.fit && page.fit.field && !page.changed;
  for (const point of page.points) drawTrail(brush, pixel, point);
  brush.strokeStyle = brush.fillStyle = colours.stroke;
  brush.lineWidth = (fitted ? 1.8 : 2.4) * pixel;
  const shown = fitted ? page.fit.demonstrations : page.strokes.map((s) => s.map((p) => p.slice(1)));
  brush.globalAlpha = fitted ? 0.75 : 1;
  for (const path of shown) {
    polyline(brush, path);
    disc(brush, ...path[0], 4 * pixel);
    brush.fill();
  }
  brush.globalAlpha = 1;
  if (page.pen) polyline(brush, page.pen.samples, 1);
  if (page.fit && page.fit.field && page.fit.goal) {
    brush.fillStyle = colours.goal;
    brush.strokeStyle = colours["goal-edge"];
    brush.lineWidth = 1.2 * pixel;
    star(brush, page.fit.goal, 13 * pixel);
    brush.fill();
    brush.stroke();
  }
  for (const point of page.points) {
    brush.fillStyle = point.lost ? colours.soft : colours.point;
    brush.strokeStyle = colours.card;
    brush.lineWidth = 2 * pixel;
    disc(brush, ...point.at, (point === page.held ? 8 : 5.5) * pixel);
    brush.fill();
    brush.stroke();
  }
  if (page.cross.shown) {
    const { x, y } = page.cross;
    brush.strokeStyle = colours.ink;
    brush.lineWidth = 1.5 * pixel;
    brush.beginPath();
    brush.moveTo(x - 3, y);
    brush.lineTo(x + 3, y);
    brush.moveTo(x, y - 3);
    brush.lineTo(x, y + 3);
    brush.stroke();
  }
}

function drawTrail(brush, pixel, point) {
  brush.strokeStyle = colours.point;
  brush.lineWidth = 1.8 * pixel;
  brush.globalAlpha = 0.7;
  if (point.trail.length) polyline(brush, [...point.trail, point.at]);
  if (point.jump) {
    brush.setLineDash([4 * pixel, 5 * pixel]);
    brush.lineWidth = 1.3 * pixel;
    polyline(brush, point.jump);
    brush.setLineDash([]);
  }
  brush.globalAlpha = 1;
}

let [wanted, dirty] = [false, false];

function redraw() {
  dirty = true;
  if (!wanted) requestAnimationFrame(frame);
  wanted = true;
}

// Points creep up to where they rest: what moves by less than a fourth of a pixel is not drawn anew.
function frame(now) {
  const moves = advance(now);
  const quarter = HALF / 2 / Math.max(1, surface.clientWidth);
  if (dirty || page.points.some((p) => distance(p.at, p.drawn || [Infinity, 0]) > quarter)) {
    drawSurface();
    for (const point of page.points) point.drawn = [...point.at];
  }
  dirty = false;
  wanted = moves;
  if (moves) requestAnimationFrame(frame);
}

function redrawAll() {
  readColours();
  drawField();
  redraw();
}

// Strokes ---------------------------------------------------------------------------------------

function setStrokes(strokes, { remember = true } = {}) {
  if (remember) page.past.push(page.strokes);
  page.strokes = strokes;
  page.changed = Boolean(page.fit);
  refresh();
}

function lengthOf(stroke) {
  return stroke.slice(1).reduce((sum, p, i) => sum + distance(p.slice(1), stroke[i].slice(1)), 0);
}

function refresh() {
  const items = page.strokes.map((stroke, i) => {
    const item = document.createElement("li");
    const seconds = stroke[stroke.length - 1][0] - stroke[0][0];
    const text = document.createElement("span");
    text.textContent = `Stroke ${i + 1}: ${seconds.toFixed(1)} s, ${Math.round(lengthOf(stroke))} mm`;
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = "Delete";
    button.setAttribute("aria-label", `Delete stroke ${i + 1}`);
    button.addEventListener("click", () => {
      setStrokes(page.strokes.filter((_, k) => k !== i));
      say(`Stroke ${i + 1} is deleted.`);
      ($("strokes").querySelector("button") || $("example")).focus();
    });
    item.append(text, button);
    return item;
  });
  $("strokes").replaceChildren(...items);
  $("undo").disabled = !page.past.length;
  $("clear").disabled = !page.strokes.length;
  $("fit").disabled = !page.strokes.length;
  $("hint").hidden = Boolean(page.strokes.length || page.pen || page.points.length || page.fit);
  $("advice").textContent = chosen("kind") === "goal"
    ? "Draw it from start to end, three times or more. All strokes should end at one point: they are shifted to the mean of their ends."
    : "Go round at least one and a half times without lifting, better three times; one stroke does, several are better.";
  offer();
  redraw();
}

function offer() {
  const { fit } = page;
  const running = Boolean(fit && fit.running);
  const shown = Boolean(fit && fit.field);
  $("stop").hidden = !running;
  $("running").hidden = !running;
  $("refine").hidden = !(shown && fit.refines && !running && !page.changed && !fit.refined);
  $("found").hidden = !shown;
  $("stale").hidden = !(shown && page.changed);
  $("field").classList.toggle("stale", shown && page.changed);
  $("points-card").hidden = !shown;
  $("save-card").hidden = !shown;
  document.querySelector("input[value=run]").disabled = !shown;
  $("push").disabled = $("remove").disabled = !page.points.length;
  $("fit").textContent = fit && page.changed ? "Fit again" : "Fit";
}

function penDown(pointer, time, place) {
  page.pen = { pointer, begin: time, samples: [[0, ...place]] };
  complain("");
  refresh();
}

function penMove(time, place) {
  const { samples, begin } = page.pen;
  const t = time - begin;
  if (t > samples[samples.length - 1][0]) samples.push([t, ...place]);
  else samples[samples.length - 1] = [samples[samples.length - 1][0], ...place];
  redraw();
}

function penUp(time, place) {
  if (place) penMove(time, place);
  const { samples } = page.pen;
  page.pen = null;
  if (samples.length < 3 || lengthOf(samples) < 5) {
    say("That was a dot rather than a stroke: hold the button or the pen down while you draw.");
    refresh();
    return;
  }
  if (page.strokes.length >= MOST_STROKES) {
    complain(`${MOST_STROKES} strokes are the most: delete some.`);
    refresh();
    return;
  }
  setStrokes([...page.strokes, samples]);
  const n = page.strokes.length;
  say(n < 3 ? `${plural(n, "stroke")}: draw it again, or press Fit.` : `${plural(n, "stroke")}: press Fit.`);
}

surface.addEventListener("pointerdown", (event) => {
  if (!event.isPrimary || event.button !== 0) return;
  event.preventDefault();
  surface.focus({ preventScroll: true });
  surface.setPointerCapture(event.pointerId);
  page.cross.shown = false;
  const place = placeOf(event);
  if (chosen("tool") === "draw") {
    penDown(event.pointerId, event.timeStamp / 1000, place);
    return;
  }
  const reach = (REACH * 2 * HALF) / surface.clientWidth;
  const near = page.points.filter((p) => distance(p.at, place) <= reach);
  near.sort((a, b) => distance(a.at, place) - distance(b.at, place));
  if (near.length) {
    [page.held] = near;
    page.heldFrom = [...page.held.at];
    stopPath(page.held);
    page.held.trail = [];
  } else {
    dropPoints([place]);
  }
  redraw();
});

surface.addEventListener("pointermove", (event) => {
  if (!event.isPrimary) return;
  if (page.pen && page.pen.pointer === event.pointerId) {
    const all = event.getCoalescedEvents ? event.getCoalescedEvents() : [];
    for (const e of all.length ? all : [event]) penMove(e.timeStamp / 1000, placeOf(e));
  } else if (page.held) {
    page.held.at = placeOf(event).map((v) => Math.max(-HALF, Math.min(HALF, v)));
    page.held.jump = [page.heldFrom, page.held.at];
    redraw();
  }
});

surface.addEventListener("pointerup", (event) => {
  if (page.pen && page.pen.pointer === event.pointerId) {
    penUp(event.timeStamp / 1000, null);
  } else if (page.held && event.isPrimary) {
    const point = page.held;
    page.held = null;
    follow([point]);
  }
});

surface.addEventListener("pointercancel", (event) => {
  if (page.pen && page.pen.pointer === event.pointerId) {
    page.pen = null;
    complain("The browser took the pointer over in the middle of the stroke: draw it again.");
    refresh();
  }
  if (page.held) {
    const point = page.held;
    page.held = null;
    follow([point]);
  }
});

surface.addEventListener("contextmenu", (event) => event.preventDefault());

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

surface.addEventListener("keydown", (event) => {
  const arrow = ARROWS[event.key];
  const { cross } = page;
  if (arrow) {
    const step = event.shiftKey ? 8 : 2;
    cross.x = Math.max(-HALF, Math.min(HALF, cross.x + step * arrow[0]));
    cross.y = Math.max(-HALF, Math.min(HALF, cross.y + step * arrow[1]));
    cross.shown = true;
    if (page.pen && page.pen.pointer === "keys") penMove(event.timeStamp / 1000, [cross.x, cross.y]);
    redraw();
  } else if (event.key === "Enter" || event.key === " ") {
    cross.shown = true;
    if (chosen("tool") === "run") dropPoints([[cross.x, cross.y]]);
    else if (page.pen) penUp(event.timeStamp / 1000, null);
    else {
      penDown("keys", event.timeStamp / 1000, [cross.x, cross.y]);
      say("The pen is down: move it by the arrows, lift it by Enter.");
    }
  } else if (event.key === "Delete" || event.key === "Backspace") {
    if (chosen("tool") === "run") removePoints(page.points.slice(-1));
    else if (page.strokes.length) setStrokes(page.strokes.slice(0, -1));
  } else if (event.key === "Escape" && page.pen) {
    page.pen = null;
    refresh();
  } else {
    return;
  }
  event.preventDefault();
});

surface.addEventListener("blur", () => {
  page.cross.shown = false;
  if (page.pen && page.pen.pointer === "keys") page.pen = null;
  refresh();
});

function undo() {
  if (!page.past.length) return;
  setStrokes(page.past.pop(), { remember: false });
  say(`Undone: ${plural(page.strokes.length, "stroke")}.`);
}

$("undo").addEventListener("click", undo);
document.addEventListener("keydown", (event) => {
  if ((event.ctrlKey || event.metaKey) && event.key === "z" && event.target.tagName !== "INPUT") {
    event.preventDefault();
    undo();
  }
});
$("clear").addEventListener("click", () => {
  setStrokes([]);
  takeUp("draw");
  say("The strokes are cleared; Undo brings them back.");
});

// Three strokes as a hand might draw them: an S, or rounds of a bean.
$("example").addEventListener("click", () => {
  const goes = chosen("kind") === "cycle";
  const strokes = [0, 1, 2].map((k) => {
    const duration = goes ? 4.4 : 1.7 + 0.1 * k;
    const stroke = [];
    for (let t = 0; t <= duration; t += 1 / 60) {
      const u = t / duration;
      let place;
      if (goes) {
        const a = 2 * Math.PI * (t / 1.7 + 0.3 * k);
        place = [
          (30 + k) * Math.cos(a) + 7 * Math.cos(2 * a + 0.4),
          (25 - k) * Math.sin(a) - 5 * Math.cos(2 * a),
        ];
      } else {
        const s = u ** 3 * (10 - 15 * u + 6 * u * u); // least jerk
        const a = 0.35 * Math.PI + 1.5 * Math.PI * s * 1.22;
        place = [
          26 * Math.sin(a * 1.35) * (1 - 0.15 * s) + 4 * (k - 1) * (1 - s),
          36 - 70 * s + 3 * (k - 1) * (1 - s),
        ];
      }
      stroke.push([t, ...place]);
    }
    return stroke;
  });
  setStrokes(strokes);
  say("An example: three strokes. Press Fit.");
});

// Fitting ---------------------------------------------------------------------------------------

async function startFit() {
  complain("");
  say(methods.length ? "Fitting …" : "The server is still starting; then it fits …");
  $("fit").disabled = true;
  page.asked += 1;
  const mine = page.asked;
  const rounded = (v) => Math.round(v * 1e4) / 1e4;
  try {
    const answer = await ask("fits", {
      kind: chosen("kind"),
      method: $("method").value,
      strokes: page.strokes.map((stroke) => stroke.map((p) => p.map(rounded))),
    });
    if (mine !== page.asked) return;
    say("Fitting …");
    removePoints(page.points);
    page.fit = { ...answer, version: 0, field: null, running: true, refined: false };
    page.changed = false;
    $("notices").replaceChildren(...answer.notices.map((text) => {
      const item = document.createElement("li");
      item.textContent = text;
      return item;
    }));
    redrawAll();
    await watch(page.fit);
  } catch (error) {
    if (mine === page.asked) complain(error.message);
  } finally {
    refresh();
  }
}

const sleep = (ms) => new Promise((resolve) => { setTimeout(resolve, ms); });

// Follow a fit to its end; show every model as it comes.
async function watch(fit) {
  fit.running = true;
  refresh();
  try {
    for (;;) {
      const told = await ask(`fits/${fit.id}`);
      if (page.fit !== fit) return;
      if (told.version > fit.version) await show(fit);
      if (page.fit !== fit) return;
      if (told.state !== "running") {
        finish(fit, told);
        return;
      }
      $("progress-label").textContent = told.label ? `Training, ${told.label}` : "Fitting";
      if (told.label) $("progress").value = told.progress;
      else $("progress").removeAttribute("value");
      await sleep(POLL);
    }
  } finally {
    fit.running = false;
    refresh();
  }
}

function finish(fit, told) {
  if (told.state === "failed") complain(`The fit failed. ${told.message}`);
  else if (told.state === "stopped") say(fit.field ? "Stopped; the last model stays." : "Stopped before there was a model.");
  else say(`Fitted by ${fit.field.method}. Drop points on the sheet, or push one.`);
}

async function show(fit) {
  const first = !fit.field;
  const field = await ask(`fits/${fit.id}/field`);
  if (page.fit !== fit) return;
  fit.field = field;
  fit.version = field.version;
  const error = field.error === null ? "is lost: it leaves for far away"
    : `is ${field.error < 10 ? field.error.toFixed(1) : Math.round(field.error)} mm from your strokes`;
  const what = fit.period === null ? "The learned motion, from where you began," : "The learned cycle";
  $("learned").textContent = `${field.method}${field.label ? `, ${field.label}` : ""}: ${field.cpu_seconds.toFixed(1)} s of one core. `
    + `${what} ${error} (${fit.period === null ? "mean Fréchet distance" : "mean distance"}).`;
  const badge = $("guarantee");
  badge.className = `badge ${field.guarantee.kind}`;
  badge.textContent = field.guarantee.kind;
  $("reason").textContent = field.guarantee.reason;
  drawField();
  offer();
  if (first) {
    takeUp("run");
    say("A first model is there: drop points on the sheet.");
  }
  const here = page.points.filter((p) => p !== page.held);
  here.forEach(stopPath);
  if (here.length) follow(here);
  redraw();
}

$("fit").addEventListener("click", startFit);
$("refine").addEventListener("click", async () => {
  const { fit } = page;
  complain("");
  try {
    await ask(`fits/${fit.id}/refine`, {});
    fit.refined = true;
    say("Refining; what is shown stays until then.");
    await watch(fit);
  } catch (error) {
    complain(error.message);
  }
});
$("stop").addEventListener("click", async () => {
  const { fit } = page;
  fit.refined = false;
  try {
    await ask(`fits/${fit.id}/stop`, {});
  } catch (error) {
    complain(error.message);
  }
});

// Points ----------------------------------------------------------------------------------------

// Points run along paths that the server makes: the system's own steps. A path is handed out for a
// while; before its end the next piece is asked for.

function stopPath(point) {
  point.path = null;
  point.order = (point.order || 0) + 1; // what is still under way for it is old
  point.rests = point.lost = false;
}

function dropPoints(places) {
  if (!page.fit || !page.fit.field) return;
  const room = MOST_POINTS - page.points.length;
  if (places.length > room) complain(`${MOST_POINTS} points are the most: remove some.`);
  const fresh = places.slice(0, room).map((at) => {
    const point = { number: page.nextPoint, at: [...at], trail: [], jump: null };
    page.nextPoint += 1;
    stopPath(point);
    return point;
  });
  page.points.push(...fresh);
  if (fresh.length) follow(fresh);
  offer();
}

function removePoints(points) {
  page.points = page.points.filter((p) => !points.includes(p));
  if (points.includes(page.held)) page.held = null;
  tellPoints();
  offer();
  redraw();
}

// Ask for the paths of points from where they are.
async function follow(points) {
  const { fit } = page;
  const orders = points.map((p) => p.order);
  try {
    const answer = await ask(`fits/${fit.id}/paths`, { starts: points.map((p) => p.at) });
    if (page.fit !== fit) return;
    points.forEach((point, i) => {
      if (point.order !== orders[i] || point === page.held) return;
      point.path = answer.paths[i];
      point.dt = answer.dt;
      point.begin = performance.now();
      point.done = 0;
      judge(point, answer.lost[i]);
    });
    redraw();
  } catch (error) {
    complain(error.message);
  }
}

// Ask for what comes after the paths' ends.
async function goOn(points) {
  const { fit } = page;
  const orders = points.map((p) => p.order);
  points.forEach((p) => { p.asks = true; });
  try {
    const starts = points.map((p) => p.path[p.path.length - 1]);
    const answer = await ask(`fits/${fit.id}/paths`, { starts });
    if (page.fit !== fit) return;
    points.forEach((point, i) => {
      point.asks = false;
      if (point.order !== orders[i] || !point.path) return;
      point.path.push(...answer.paths[i].slice(1));
      judge(point, answer.lost[i]);
    });
    redraw();
  } catch (error) {
    points.forEach((p) => { p.asks = false; p.rests = true; });
    complain(error.message);
  }
}

// Whether a path ends: at rest, or because it left for good.
function judge(point, lost) {
  const { path, dt } = point;
  const tail = path.slice(-Math.max(2, Math.round(0.5 / dt)));
  const moved = Math.max(...tail.map((p) => distance(p, path[path.length - 1])));
  point.rests = path.length > 1 && moved < RESTS;
  point.ends = lost;
}

// Move the points on to a time; return whether any still moves.
function advance(now) {
  let moves = false;
  const due = [];
  for (const point of page.points) {
    if (!point.path || point === page.held) continue;
    const { path, dt } = point;
    const at = still.matches ? path.length - 1 : Math.min((now - point.begin) / 1000 / dt, path.length - 1);
    const k = Math.min(Math.floor(Math.max(at, 0)), path.length - 1);
    for (let i = point.done; i < k; i += 1) point.trail.push(path[i]);
    point.done = Math.max(point.done, k);
    if (point.trail.length > MOST_TRAIL) point.trail.splice(0, point.trail.length - MOST_TRAIL);
    const next = path[Math.min(k + 1, path.length - 1)];
    const share = Math.max(at, 0) - k;
    point.at = [path[k][0] + share * (next[0] - path[k][0]), path[k][1] + share * (next[1] - path[k][1])];
    const left = (path.length - 1 - at) * dt;
    if (left <= 0 && point.ends) point.lost = true;
    if (left > 0) moves = true;
    if (left < 0.5 && !point.rests && !point.ends && !point.asks && !still.matches) due.push(point);
    if (left <= 0 && !point.rests && !point.ends && !still.matches) {
      moves = true; // the next piece is late: time stands still until it is there
      point.begin = now - (path.length - 1) * dt * 1000;
    }
  }
  if (due.length) goOn(due);
  if (now - (advance.told || 0) > 250 || !moves) {
    advance.told = now;
    tellPoints();
  }
  return moves;
}

function nearest(place) {
  let least = Infinity;
  for (const path of page.fit.demonstrations) for (const p of path) least = Math.min(least, distance(p, place));
  return least;
}

function tellPoints() {
  const { points, fit } = page;
  if (!fit || !points.length) {
    $("count").textContent = "No points yet.";
    $("places").replaceChildren();
    return;
  }
  const lost = points.filter((p) => p.lost).length;
  const away = points.map((p) => (fit.goal ? distance(p.at, fit.goal) : nearest(p.at)));
  let text;
  if (fit.goal) {
    const there = away.filter((d) => d <= ARRIVED).length;
    text = `${plural(points.length, "point")}: ${there} within ${ARRIVED} mm of the goal`;
  } else {
    text = `${plural(points.length, "point")}, at most ${mm(Math.max(...away))} mm from your strokes`;
  }
  if (lost) text += `; ${lost} left the sheet for good`;
  $("count").textContent = `${text}.`;
  $("places").replaceChildren(...points.map((point, i) => {
    const item = document.createElement("li");
    const state = point.lost ? "gone" : point === page.held ? "held" : point.rests && point.path && point.done >= point.path.length - 1 ? "at rest" : "moving";
    item.textContent = `(${mm(point.at[0])}, ${mm(point.at[1])}) mm, ${mm(away[i])} mm from the ${fit.goal ? "goal" : "strokes"}, ${state}`;
    return item;
  }));
}

$("drop").addEventListener("click", () => {
  const places = [];
  for (let i = -2; i <= 2; i += 1) for (let j = -2; j <= 2; j += 1) places.push([22 * i, 22 * j]);
  dropPoints(places);
  redraw();
});
$("push").addEventListener("click", () => {
  const pushed = page.points.filter((p) => p !== page.held);
  for (const point of pushed) {
    const angle = 2 * Math.PI * Math.random();
    const from = point.lost ? [0, 0] : [...point.at];
    stopPath(point);
    point.at = [from[0] + 20 * Math.cos(angle), from[1] + 20 * Math.sin(angle)];
    point.trail = [];
    point.jump = [from, [...point.at]];
  }
  follow(pushed);
  say(`${plural(pushed.length, "point")} pushed by 20 mm.`);
});
$("remove").addEventListener("click", () => removePoints(page.points));

// Saving ----------------------------------------------------------------------------------------

$("save").addEventListener("submit", async (event) => {
  event.preventDefault();
  complain("");
  try {
    const { files } = await ask(`fits/${page.fit.id}/save`, { name: $("name").value });
    $("saved").textContent = `Saved ${files.join(" and ")}.`;
  } catch (error) {
    complain(error.message);
  }
});

// The rest of the controls ----------------------------------------------------------------------

function offerMethods() {
  const select = $("method");
  const before = select.value;
  const fits = methods.filter((m) => m[chosen("kind")]);
  if (fits.length) {
    select.replaceChildren(...fits.map((m) => new Option(m.title, m.name)));
    select.value = fits.some((m) => m.name === before) ? before : fits[0].name;
  }
}

function toolChanged() {
  surface.classList.toggle("runs", chosen("tool") === "run");
}

function takeUp(tool) {
  document.querySelector(`input[name=tool][value=${tool}]`).checked = true;
  toolChanged();
}

for (const input of document.querySelectorAll("input[name=tool]")) input.addEventListener("change", toolChanged);
for (const input of document.querySelectorAll("input[name=kind]")) {
  input.addEventListener("change", () => {
    page.changed = Boolean(page.fit);
    offerMethods();
    refresh();
  });
}
$("method").addEventListener("change", () => {
  page.changed = Boolean(page.fit);
  refresh();
});

new ResizeObserver(redrawAll).observe(surface);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redrawAll);
readColours();
refresh();
ask("methods").then((answer) => {
  methods = answer.methods;
  offerMethods();
}).catch((error) => complain(error.message));
