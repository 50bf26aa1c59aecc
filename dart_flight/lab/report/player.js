"use strict";
// Plays a flight from the data in the page (defined in report/player.py) as synchronised plan, side view, force, and
// a strip of the whole flight. The animation starts with the Play button.
(() => {
  const SVG = "http://www.w3.org/2000/svg";
  const box = document.getElementById("player");
  const source = document.getElementById("flight-data");
  if (!box || !source) return;
  const D = JSON.parse(source.textContent);
  const T0 = D.t[0], T1 = D.t[D.t.length - 1];
  const DASH = " – ";

  // --- small helpers -----------------------------------------------------------------------------------

  const el = (name, parent, attributes = {}, text) => {
    const e = document.createElement(name);
    for (const [k, v] of Object.entries(attributes)) e.setAttribute(k, v);
    if (text !== undefined) e.textContent = text;
    if (parent) parent.append(e);
    return e;
  };
  const svg = (name, parent, attributes = {}, text) => {
    const e = document.createElementNS(SVG, name);
    for (const [k, v] of Object.entries(attributes)) e.setAttribute(k, v);
    if (text !== undefined) e.textContent = text;
    if (parent) parent.append(e);
    return e;
  };
  // Index of the last time not after t, or 0 before the first.
  const before = (times, t) => {
    let low = 0, high = times.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (times[middle] <= t) low = middle; else high = middle - 1;
    }
    return low;
  };
  const last = (rows, t) => {
    const i = before(rows.map((row) => row[0]), t);
    return rows.length && rows[i][0] <= t ? rows[i] : null;
  };
  const at = (values, i, share) =>
    values[i] + share * (values[Math.min(i + 1, values.length - 1)] - values[i]);
  const line = (points) => points.map((p, i) => (i ? "L" : "M") + p[0].toFixed(1) + " " + p[1].toFixed(1)).join("");

  // --- view: path, hits, start and goal with a margin, in units of the drawing -------------------------

  const W = 480, M = 26;
  const xs = [...D.x, D.room.start[0], D.room.goal[0]], ys = [...D.y, D.room.start[1], D.room.goal[1]];
  const least = (v) => v.reduce((a, b) => Math.min(a, b)), most = (v) => v.reduce((a, b) => Math.max(a, b));
  const out = 570;
  const view = {x0: least(xs) - out, x1: most(xs) + out, y0: least(ys) - out, y1: most(ys) + out};
  const short = 0.55 * (view.x1 - view.x0) - (view.y1 - view.y0);
  if (short > 0) { view.y0 -= short / 2; view.y1 += short / 2; }
  const narrow = 0.75 * (view.y1 - view.y0) - (view.x1 - view.x0);
  if (narrow > 0) { view.x0 -= narrow / 2; view.x1 += narrow / 2; }
  const k = (W - M) / (view.x1 - view.x0);
  const H = k * (view.y1 - view.y0);
  const X = (x) => M + k * (x - view.x0), Y = (y) => k * (view.y1 - y);
  const zTop = most(D.z) + 350;
  const HS = k * (zTop + 150);
  const Z = (z) => k * (zTop - z);

  // --- the page's elements -----------------------------------------------------------------------------

  box.hidden = false;
  const stage = el("div", box, {class: "stage"});
  const views = el("div", stage, {class: "views"});
  const plan = svg("svg", views, {viewBox: `0 0 ${W} ${H.toFixed(0)}`, class: "plan", role: "img",
                                  "aria-label": "Flight from above"});
  const controls = el("div", views, {class: "controls"});
  const play = el("button", controls, {type: "button", id: "play"}, "▶ Play");
  const slider = el("input", controls, {type: "range", id: "time", min: T0 / 1000, max: T1 / 1000, step: 0.01,
                                        value: T0 / 1000, "aria-label": "Time of the flight, seconds"});
  const label = el("label", controls, {class: "rate"}, "speed ");
  const rate = el("select", label, {id: "rate"});
  for (const r of [0.1, 0.25, 0.5, 1]) el("option", rate, {value: r}, `${r}×`);
  rate.value = "1";
  const jumps = el("div", views, {class: "jumps", role: "group", "aria-label": "Jump to a hit, or to what the guard did"});
  const makeSide = (into) => svg("svg", into, {viewBox: `0 0 ${W} ${HS.toFixed(0)}`, class: "side", role: "img",
                                  "aria-label": "Flight from the side"});
  const beside = el("div", stage, {class: "beside"});
  const facts = el("dl", beside, {class: "facts"});
  const fact = {};
  for (const name of ["time", "phase", "speed", "height", "force"].concat(D.hasLock ? ["lock"] : [])) {
    const one = el("div", facts);
    el("dt", one, {}, name);
    fact[name] = el("dd", one, {}, DASH);
  }
  const said = el("p", beside, {class: "said"});

  // --- plan --------------------------------------------------------------------------------------------

  const hatched = (into, id) => {
    const pattern = svg("pattern", svg("defs", into), {id, width: 6, height: 6, patternUnits: "userSpaceOnUse",
                                                       patternTransform: "rotate(45)"});
    svg("rect", pattern, {width: 6, height: 6, class: "wallface"});
    svg("path", pattern, {d: "M0 0V6", class: "hatch"});
  };
  const fixed = (v, digits) => v.toFixed(digits).replace(/^-(0\.0*)$/, "$1");
  const clamp = (v, a, b) => Math.max(a, Math.min(b, v));
  hatched(plan, "hatch-plan");
  const [bx, by] = D.room.bounds;
  svg("rect", plan, {x: X(bx[0]), y: Y(by[1]), width: k * (bx[1] - bx[0]), height: k * (by[1] - by[0]),
                     class: "bounds"});
  for (const w of D.room.walls) {
    const corners = w.outline.map(([x, y]) => [X(x), Y(y)]), left = least(corners.map((p) => p[0]));
    svg("path", plan, {d: line(corners) + "Z", fill: "url(#hatch-plan)"});
    svg("path", plan, {d: line(corners.slice(0, 2)), class: "surface"});
    svg("path", plan, {d: line(w.plane.map(([x, y]) => [X(x), Y(y)])), class: "plane"});
    const upright = Math.abs(w.normal[0]) > Math.abs(w.normal[1]);
    // The name is on the visible part of the wall.
    const [mx, my] = [X(w.label[0]), Y(w.label[1])];
    const px = upright ? mx : clamp(mx, left + 40, W - 60), py = upright ? clamp(my, 60, H - 60) : my;
    svg("text", plan, {x: px, y: py, class: "name", "text-anchor": "middle", "dominant-baseline": "central",
                       transform: upright ? `rotate(90 ${px} ${py})` : ""}, w.name);
  }
  for (const p of D.room.posts) {
    const [cx, cy] = [X(p.at[0]), Y(p.at[1])], r = k * p.radius;
    svg("circle", plan, {cx, cy, r, fill: "url(#hatch-plan)", class: "surface"});
    svg("text", plan, {x: cx, y: cy - r - 8, class: "name", "text-anchor": "middle"}, p.name);
  }
  for (const way of D.planned) {
    svg("path", plan, {d: line(way.map(([x, y]) => [X(x), Y(y)])), class: "planned"});
  }
  svg("circle", plan, {cx: X(D.room.goal[0]), cy: Y(D.room.goal[1]), r: k * D.room.capture, class: "goal"});
  svg("text", plan, {x: X(D.room.goal[0]), y: Y(D.room.goal[1]), class: "star", "text-anchor": "middle",
                     "dominant-baseline": "central"}, "★");
  const path = (into, vertical, values) => {
    const d = line(D.x.map((x, i) => [X(x), vertical(values[i])]));
    svg("path", into, {d, class: "coming"});
    const flown = svg("path", into, {d, class: "flown"});
    const reached = [0];
    for (let i = 1; i < D.x.length; i++) {
      reached.push(reached[i - 1] + k * Math.hypot(D.x[i] - D.x[i - 1], values[i] - values[i - 1]));
    }
    return (i, share) => {
      flown.setAttribute("stroke-dasharray", `${at(reached, i, share).toFixed(2)} 1e6`);
    };
  };
  const planFlown = path(plan, Y, D.y);
  // One dot per second.
  for (let t = Math.ceil(T0 / 1000) * 1000; t < T1; t += 1000) {
    const i = before(D.t, t);
    svg("circle", plan, {cx: X(D.x[i]), cy: Y(D.y[i]), r: 1.7, class: "second"});
  }
  const taken = [];
  const badges = D.hits.map((h) => {
    const g = svg("g", plan, {class: "badge"});
    const [nx, ny] = h.normal;
    // Behind the wall, without covering earlier badges.
    let x = X(h.at[0] - 430 * nx), y = Y(h.at[1] - 430 * ny);
    while (taken.some(([a, b]) => Math.hypot(a - x, b - y) < 19)) { x += 19 * Math.abs(ny); y += 19 * Math.abs(nx); }
    taken.push([x, y]);
    svg("path", g, {d: line([[X(h.at[0]), Y(h.at[1])], [x, y]]), class: "leader"});
    svg("circle", g, {cx: x, cy: y, r: 9});
    svg("text", g, {x, y: y + 0.5, "text-anchor": "middle", "dominant-baseline": "central"}, h.n);
    return g;
  });
  const planSet = svg("path", plan, {class: "setpoint"});
  const vehicle = svg("g", plan, {class: "vehicle"});
  const outline = D.vehicle.guards.flat();
  const guards = D.vehicle.guards.map((guard) => line(guard.map(([x, y]) => [k * x, -k * y])) + "Z");
  svg("path", vehicle, {d: guards.join(""), class: "guards"});
  for (const [a, b] of D.vehicle.arms) {
    svg("path", vehicle, {d: line([a, b].map(([x, y]) => [k * x, -k * y])), class: "arm"});
    svg("circle", vehicle, {cx: k * b[0], cy: -k * b[1], r: 3.2, class: "motor"});
  }
  const nose = k * Math.max(...outline.map((p) => p[0]));
  svg("path", vehicle, {d: line([[nose - 7, -5], [nose, 0], [nose - 7, 5]]) + "Z", class: "nose"});
  const arrow = svg("path", plan, {class: "force"});
  svg("text", plan, {x: W - 6, y: H - 8, class: "axis", "text-anchor": "end"}, "x →  0.5 m");
  svg("path", plan, {d: line([[W - 6 - k * 500, H - 4], [W - 6, H - 4]]), class: "scale"});

  // --- force: an interval around the current time ------------------------------------------------------

  const FW = 480, FH = 170, FL = 34, FB = 22, HALF = 300;
  const F = D.force;
  const size = F.t.map((_, i) => Math.hypot(F.x[i], F.y[i]) / 10);
  const top = Math.max(10, most([0, ...size]), most([0, ...F.true.map((v) => v / 10)])) * 1.08;
  const FY = (n) => FH - FB - (FH - FB - 8) * n / top, PX = (FW - FL) / (2 * HALF);
  const forcePlot = svg("svg", beside, {viewBox: `0 0 ${FW} ${FH}`, class: "strip", role: "img",
                                        "aria-label": "Horizontal force about the moment shown"});
  const clip = svg("clipPath", svg("defs", forcePlot), {id: "force-clip"});
  svg("rect", clip, {x: FL, y: 0, width: FW - FL, height: FH - FB});
  for (let n = 0, step = top > 80 ? 40 : top > 40 ? 20 : 10; n < top; n += step) {
    svg("path", forcePlot, {d: `M${FL} ${FY(n)}H${FW}`, class: "grid"});
    svg("text", forcePlot, {x: FL - 5, y: FY(n), class: "axis", "text-anchor": "end",
                            "dominant-baseline": "central"}, n);
  }
  const held = svg("g", forcePlot, {"clip-path": "url(#force-clip)"});
  const moving = svg("g", held);
  const forceLine = (values, name) =>
    svg("path", moving, {d: line(F.t.map((t, i) => [PX * (t - T0), FY(values[i])])), class: name});
  if (F.true.length) forceLine(F.true.map((v) => v / 10), "true");
  if (F.t.length) forceLine(size, "estimated");
  svg("path", held, {d: `M${FL} ${FY(D.threshold / 10)}H${FW}`, class: "plane"});
  const now = FL + PX * HALF;
  svg("path", forcePlot, {d: `M${now} 0V${FH - FB}`, class: "cursor"});
  for (const t of [-200, 0, 200]) {
    svg("text", forcePlot, {x: now + PX * t, y: FH - 6, class: "axis", "text-anchor": "middle"},
        t ? `${t > 0 ? "+" : "−"}${Math.abs(t)} ms` : "now");
  }
  svg("text", forcePlot, {x: FL + 4, y: 12, class: "axis"},
      "horizontal force, N" + (F.true.length ? ": estimated (dashed), true" : ": estimated"));

  // --- the whole flight: force, lock, phases; click or drag to seek ------------------------------------

  const OH = 118, OX = (t) => FL + (FW - FL) * (t - T0) / (T1 - T0);
  const whole = svg("svg", beside, {viewBox: `0 0 ${FW} ${OH}`, class: "strip whole", role: "img",
                                    "aria-label": "The whole flight: force" + (D.hasLock ? ", lock" : "") + " and phases"});
  const OY = (n) => 52 - 40 * n / top;
  if (F.t.length) svg("path", whole, {d: line(F.t.map((t, i) => [OX(t), OY(size[i])])), class: "estimated solid"});
  const bars = (rows, y, name, classOf) => {
    svg("text", whole, {x: 0, y: y + 8, class: "axis", "dominant-baseline": "central"}, name);
    rows.forEach(([t, value], i) => {
      const a = OX(clamp(t, T0, T1)), b = OX(clamp(i + 1 < rows.length ? rows[i + 1][0] : T1, T0, T1));
      if (b > a) {
        const bar = svg("rect", whole, {x: a, y, width: b - a, height: 15, class: classOf(value, i)});
        svg("title", bar, {}, value);
        if (b - a > 7 * value.length) {
          svg("text", whole, {x: (a + b) / 2, y: y + 8, class: "inbar " + classOf(value, i), "text-anchor": "middle",
                              "dominant-baseline": "central"}, value);
        }
      }
    });
  };
  if (D.hasLock) bars(D.lock, 58, "lock", (value) => `lock-${value}`);
  bars(D.phases, 78, "", (_, i) => (i % 2 ? "phase-odd" : "phase-even"));
  for (const h of D.hits) {
    svg("text", whole, {x: OX(h.t), y: 9, class: "axis hit", "text-anchor": "middle"}, h.n);
  }
  for (const g of D.guard) svg("text", whole, {x: OX(g.t), y: 20, class: "axis guard", "text-anchor": "middle"}, "◆");
  const span = (T1 - T0) / 1000, tick = [1, 2, 5, 10, 20, 50, 100, 200].find((s) => span / s <= 9) || 500;
  for (let s = Math.ceil(T0 / 1000 / tick) * tick; s <= T1 / 1000; s += tick) {
    svg("text", whole, {x: clamp(OX(1000 * s), FL + 8, FW - 12), y: OH - 6, class: "axis", "text-anchor": "middle"},
        `${s} s`);
  }
  const cursor = svg("path", whole, {class: "cursor"});

  // --- side --------------------------------------------------------------------------------------------

  const side = makeSide(beside);
  hatched(side, "hatch-side");
  for (const w of D.room.walls) {
    const x = w.outline.map((p) => X(p[0]));
    svg("rect", side, {x: least(x), y: 0, width: most(x) - least(x), height: Z(0),
                       ...(Math.abs(w.normal[0]) > 0.5 ? {fill: "url(#hatch-side)"} : {class: "behind"})});
  }
  for (const p of D.room.posts) {
    svg("rect", side, {x: X(p.at[0] - p.radius), y: 0, width: 2 * k * p.radius, height: Z(0), class: "behind"});
  }
  svg("path", side, {d: line([[M, Z(0)], [W, Z(0)]]), class: "surface"});
  for (const z of D.room.bounds[2]) svg("path", side, {d: line([[M, Z(z)], [W, Z(z)]]), class: "bounds"});
  for (let z = 0; z <= zTop; z += 1000) {
    svg("text", side, {x: M - 5, y: Z(z), class: "axis", "text-anchor": "end", "dominant-baseline": "central"},
        `${z / 1000}`);
  }
  svg("text", side, {x: M + 6, y: 14, class: "axis"}, "height, m");
  const sideFlown = path(side, Z, D.z);
  for (const h of D.hits) svg("circle", side, {cx: X(h.at[0]), cy: Z(h.z), r: 3, class: "dot"});
  const sideSet = svg("path", side, {class: "setpoint"});
  const body = svg("path", side, {class: "guards"});
  const disc = svg("path", side, {class: "arm"});

  // --- one frame ---------------------------------------------------------------------------------------

  // Forward and left axes of the body in the mission frame, from yaw, pitch (nose up), roll (left side up).
  const axes = (yaw, pitch, roll) => {
    const cy = Math.cos(yaw), sy = Math.sin(yaw), cp = Math.cos(pitch), sp = Math.sin(pitch);
    const cr = Math.cos(roll), sr = Math.sin(roll);
    const level = [-sy, cy, 0], up = [-sp * cy, -sp * sy, cp];
    return [[cp * cy, cp * sy, sp], level.map((v, i) => cr * v + sr * up[i])];
  };
  const cross = (x, y) => `M${x - 5} ${y - 5}l10 10m0 -10l-10 10`;
  let t = T0;

  const show = () => {
    const i = before(D.t, t), gap = i + 1 < D.t.length ? D.t[i + 1] - D.t[i] : 1;
    const share = clamp((t - D.t[i]) / gap, 0, 1);
    const x = at(D.x, i, share), y = at(D.y, i, share), z = at(D.z, i, share);
    const [yaw, pitch, roll] = [D.yaw, D.pitch, D.roll].map((v) => at(v, i, share) / 1000);
    planFlown(i, share);
    sideFlown(i, share);
    vehicle.setAttribute("transform",
      `translate(${X(x).toFixed(2)} ${Y(y).toFixed(2)}) rotate(${(-yaw * 180 / Math.PI).toFixed(2)})`);
    const [f, l] = axes(yaw, pitch, roll);
    const seen = ([a, b], lift) => [X(x + a * f[0] + b * l[0]), Z(z + a * f[2] + b * l[2] + lift)];
    const low = outline.map((p) => seen(p, -25)), high = outline.map((p) => seen(p, 25));
    const order = (points) => [...points].sort((p, q) => p[0] - q[0]);
    const [a, b] = [order(low), order(high)];
    body.setAttribute("d", line([a[0], a[a.length - 1], b[b.length - 1], b[0]]) + "Z");
    disc.setAttribute("d", D.vehicle.arms.map((arm) => line(arm.map((p) => seen(p, 25)))).join(""));

    const set = last(D.setpoints, t);
    planSet.setAttribute("d", set ? cross(X(set[1]), Y(set[2])) + line([[X(x), Y(y)], [X(set[1]), Y(set[2])]]) : "");
    sideSet.setAttribute("d", set ? cross(X(set[1]), Z(set[3])) : "");

    const lock = last(D.lock, t), phase = last(D.phases, t);
    const state = lock ? lock[1] : "unknown";
    vehicle.setAttribute("class", `vehicle ${state}`);

    let newtons = null;
    arrow.setAttribute("d", "");
    if (F.t.length) {
      const j = before(F.t, t), next = Math.min(j + 1, F.t.length - 1);
      const part = next > j ? clamp((t - F.t[j]) / (F.t[next] - F.t[j]), 0, 1) : 0;
      const fx = at(F.x, j, part) / 10, fy = at(F.y, j, part) / 10;
      newtons = Math.hypot(fx, fy);
      if (newtons > D.threshold / 10) {
        const scale = 0.16 * W / top, ex = X(x) + scale * fx, ey = Y(y) - scale * fy;
        const back = (turn) => {
          const c = Math.cos(turn), s = Math.sin(turn), ux = fx / newtons, uy = -fy / newtons;
          return `M${ex} ${ey}l${-9 * (c * ux - s * uy)} ${-9 * (s * ux + c * uy)}`;
        };
        arrow.setAttribute("d", line([[X(x), Y(y)], [ex, ey]]) + back(0.45) + back(-0.45));
      }
    }
    moving.setAttribute("transform", `translate(${(now - PX * (t - T0)).toFixed(2)} 0)`);
    cursor.setAttribute("d", `M${OX(t).toFixed(1)} 10V${OH - 18}`);
    badges.forEach((g, n) => g.classList.toggle("past", D.hits[n].t <= t));

    const text = {
      time: `${(t / 1000).toFixed(2)} s`,
      phase: phase ? phase[1] : DASH,
      speed: `${fixed(at(D.speed, i, share) / 100, 2)} m/s`,
      height: `${fixed(z / 1000, 2)} m`,
      force: newtons === null ? DASH : `${fixed(newtons, 1)} N`,
      ...(D.hasLock ? {lock: state} : {}),
    };
    for (const [name, value] of Object.entries(text)) {
      if (fact[name].textContent !== value) fact[name].textContent = value;
    }
    const hit = [...D.hits].reverse().find((h) => h.t <= t && t < h.t + 1500);
    const act = [...D.guard].reverse().find((g) => g.t <= t && t < g.t + 3000);
    const words = act ? `guard: ${act.rule}: ${act.action}`
      : hit ? `hit ${hit.n}: ${hit.wall}, ${hit.mode}` + (hit.force === null ? "" : `, ${(hit.force / 10).toFixed(0)} N`)
      : "";
    if (said.textContent !== words) said.textContent = words;
    slider.value = t / 1000;
    slider.setAttribute("aria-valuetext", `${text.time}, ${text.phase}`);
  };

  // --- time --------------------------------------------------------------------------------------------

  let frame = null, shown = null;
  const stop = () => {
    if (frame !== null) cancelAnimationFrame(frame);
    frame = shown = null;
    play.textContent = "▶ Play";
    play.setAttribute("aria-pressed", "false");
  };
  const step = (moment) => {
    if (shown !== null) t = Math.min(T1, t + (moment - shown) * Number(rate.value));
    shown = moment;
    show();
    if (t >= T1) stop(); else frame = requestAnimationFrame(step);
  };
  const toggle = () => {
    if (frame !== null) { stop(); return; }
    if (t >= T1) t = T0;
    play.textContent = "❚❚ Pause";
    play.setAttribute("aria-pressed", "true");
    frame = requestAnimationFrame(step);
  };
  const go = (moment) => { t = clamp(moment, T0, T1); show(); };

  play.setAttribute("aria-pressed", "false");
  play.addEventListener("click", toggle);
  slider.addEventListener("input", () => go(1000 * slider.valueAsNumber));
  const marks = () => [T0, ...[...D.hits, ...D.guard].map((one) => one.t).sort((a, b) => a - b), T1];
  slider.addEventListener("keydown", (event) => {
    if (event.key === " ") toggle();
    else if (event.key === "PageDown") go(marks().find((m) => m > t + 1) ?? T1);
    else if (event.key === "PageUp") go(marks().reverse().find((m) => m < t - 1) ?? T0);
    else return;
    event.preventDefault();
  });
  for (const h of D.hits) {
    const jump = el("button", jumps, {type: "button", "data-hit": h.n, title: `${h.wall}, ${h.mode}`}, `hit ${h.n}`);
    jump.addEventListener("click", () => go(h.t));
  }
  for (const g of D.guard) {
    const jump = el("button", jumps, {type: "button", title: `${g.rule}: ${g.action}`}, "guard");
    jump.addEventListener("click", () => go(g.t));
  }
  const there = (event) => {
    const r = whole.getBoundingClientRect();
    go(T0 + (T1 - T0) * ((event.clientX - r.left) / r.width * FW - FL) / (FW - FL));
  };
  whole.addEventListener("pointerdown", (event) => { whole.setPointerCapture(event.pointerId); there(event); });
  whole.addEventListener("pointermove", (event) => { if (event.buttons) there(event); });
  show();
})();
