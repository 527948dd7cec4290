// Point chains moving in three dimensions on a plain canvas: z up, metres, orbit by dragging.
(() => {
  const GAP = -32768;
  const FOCAL = 5; // distance of the eye in radii of the scene: a mild perspective
  const TRAIL = 1; // seconds that the bold part of the tip's path lasts
  const root = document.documentElement;
  const variable = (name) => getComputedStyle(root).getPropertyValue("--" + name).trim();

  function element(name, attributes = {}, ...children) {
    const made = Object.assign(document.createElement(name), attributes);
    made.append(...children);
    return made;
  }

  function decoded(group) {
    for (const chain of group.chains) {
      const bytes = Uint8Array.from(atob(chain.data), (c) => c.charCodeAt(0));
      const view = new DataView(bytes.buffer);
      chain.at = Float32Array.from({ length: bytes.length / 2 }, (_, i) => {
        const number = view.getInt16(2 * i, true);
        return number === GAP ? NaN : group.offset + group.step * number;
      });
      chain.shown = true;
    }
    group.low = [0, 1, 2].map((axis) => extreme(group, axis, Math.min));
    group.high = [0, 1, 2].map((axis) => extreme(group, axis, Math.max));
    group.centre = group.low.map((low, axis) => (low + group.high[axis]) / 2);
    group.flat = group.high[2] - group.low[2] < 1e-6;
    group.radius = Math.max(Math.hypot(...group.low.map((low, axis) => group.high[axis] - low)) / 2, 1e-3);
    return group;
  }

  function extreme(group, axis, choose) {
    let found = NaN;
    for (const chain of group.chains)
      for (let i = axis; i < chain.at.length; i += 3)
        if (!isNaN(chain.at[i])) found = isNaN(found) ? chain.at[i] : choose(found, chain.at[i]);
    return isNaN(found) ? 0 : found;
  }

  // A marker's outline for each look, the same shapes as in the charts.
  const MARKERS = [
    (c, x, y, r) => c.arc(x, y, r, 0, 7),
    (c, x, y, r) => polygon(c, [[x, y - 1.3 * r], [x + 1.3 * r, y], [x, y + 1.3 * r], [x - 1.3 * r, y]]),
    (c, x, y, r) => c.rect(x - r, y - r, 2 * r, 2 * r),
    (c, x, y, r) => polygon(c, [[x, y - 1.3 * r], [x + 1.2 * r, y + r], [x - 1.2 * r, y + r]]),
    (c, x, y, r) => { c.rect(x - 1.3 * r, y - 0.45 * r, 2.6 * r, 0.9 * r); c.rect(x - 0.45 * r, y - 1.3 * r, 0.9 * r, 2.6 * r); },
    (c, x, y, r) => polygon(c, [[x - r, y - r], [x + r, y - r], [x - r, y + r], [x + r, y + r]]),
  ];
  function polygon(c, corners) {
    corners.forEach(([x, y], i) => (i ? c.lineTo(x, y) : c.moveTo(x, y)));
    c.closePath();
  }

  function player(place) {
    const data = place.querySelector("script");
    const groups = JSON.parse(data.textContent).groups.map(decoded);
    data.remove();
    const canvas = element("canvas", { tabIndex: 0 });
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", "The object in motion. Arrow keys turn the view, space plays and pauses.");
    const context = canvas.getContext("2d");
    let group = groups[0], time = group.time[0], playing = false, before = null;
    let yaw = -0.9, pitch = 0.28, beside = false;

    // --- controls
    const play = element("button", { className: "play", onclick: () => run(!playing) });
    const slider = element("input", { type: "range", step: "any", oninput: () => { run(false); seek(+slider.value); } });
    slider.setAttribute("aria-label", "Time");
    const clock = element("output");
    const speed = element("select", { title: "Speed" }, ...[1, 0.5, 0.25, 0.1].map((s) => new Option(`${s}× speed`, s)));
    const motion = element("select", { title: "Motion", hidden: groups.length < 2, onchange: () => choose(groups[motion.value]) },
      ...groups.map((g, i) => new Option(g.name || "motion", i)));
    const apart = element("button", { className: "beside", onclick: () => { beside = !beside; legend(); draw(); } }, "side by side");
    const chains = element("div", { className: "controls" });
    place.append(canvas,
      element("div", { className: "controls" }, play, slider, clock, speed), chains);

    function legend() {
      apart.setAttribute("aria-pressed", beside);
      apart.hidden = group.chains.length < 2;
      chains.replaceChildren(motion, ...group.chains.map((chain) => {
        const swatch = element("canvas", { width: 68, height: 24, style: "width:34px;height:12px;background:none" });
        const c = swatch.getContext("2d");
        c.scale(2, 2);
        stroke(c, chain, [[0, 6], [34, 6]]);
        marker(c, chain, 17, 6, 3);
        const button = element("button", { className: "chain", onclick: () => { chain.shown = !chain.shown; legend(); draw(); } }, swatch, chain.label);
        button.setAttribute("aria-pressed", chain.shown);
        return button;
      }), apart);
    }

    function choose(next) {
      group = next;
      if (group.flat) [yaw, pitch] = [0, Math.PI / 2]; // from above
      slider.min = group.time[0];
      slider.max = group.time[group.time.length - 1];
      legend();
      seek(group.time[0]);
    }
    function seek(to) {
      time = to;
      slider.value = to;
      clock.value = `${time.toFixed(2)} / ${(+slider.max).toFixed(2)} s`;
      draw();
    }
    function run(on) {
      playing = on;
      before = null;
      play.textContent = on ? "❚❚ pause" : "▶ play";
      if (on && time >= +slider.max) seek(+slider.min);
      if (on) requestAnimationFrame(tick);
    }
    function tick(now) {
      if (!playing) return;
      const next = time + (before === null ? 0 : Math.min((now - before) / 1000, 0.1) * speed.value);
      before = now;
      seek(next > +slider.max ? +slider.min : next);
      requestAnimationFrame(tick);
    }

    // --- drawing
    function projection(column, columns, width, height) {
      const [sy, cy, sp, cp] = [Math.sin(yaw), Math.cos(yaw), Math.sin(pitch), Math.cos(pitch)];
      const scale = Math.min(0.5 * width / columns, 0.47 * height) / group.radius;
      return (x, y, z) => {
        x -= group.centre[0]; y -= group.centre[1]; z -= group.centre[2];
        const [right, away] = [cy * x - sy * y, sy * x + cy * y];
        const [up, depth] = [cp * z + sp * away, cp * away - sp * z];
        const nearer = scale / (1 + depth / (FOCAL * group.radius));
        return [width * (column + 0.5) / columns + right * nearer, height * 0.48 - up * nearer];
      };
    }

    function frame() {
      let after = group.time.findIndex((t) => t >= time);
      if (after < 0) after = group.time.length - 1;
      const before = Math.max(after - 1, 0), span = group.time[after] - group.time[before];
      return [before, after, span ? (time - group.time[before]) / span : 0];
    }

    function points(chain, [before, after, share]) {
      const size = 3 * chain.points;
      return Array.from({ length: chain.points }, (_, p) => [0, 1, 2].map((axis) =>
        (1 - share) * chain.at[before * size + 3 * p + axis] + share * chain.at[after * size + 3 * p + axis]));
    }

    function tip(chain, frame) {
      const last = 3 * (chain.points * (frame + 1) - 1);
      return chain.at.subarray(last, last + 3);
    }

    // Consecutive points as lines; a gap is left open.
    function trace(c, at) {
      c.beginPath();
      let drawing = false;
      for (const [x, y] of at) {
        if (isNaN(x)) drawing = false;
        else if (drawing) c.lineTo(x, y);
        else { c.moveTo(x, y); drawing = true; }
      }
    }
    function stroke(c, chain, at) {
      c.strokeStyle = variable("series-" + chain.look);
      c.lineWidth = chain.width;
      c.lineJoin = "round";
      c.setLineDash(chain.dash);
      trace(c, at);
      c.stroke();
      c.setLineDash([]);
    }
    function marker(c, chain, x, y, r) {
      if (isNaN(x)) return;
      c.beginPath();
      MARKERS[chain.look](c, x, y, r);
      c.fillStyle = variable("series-" + chain.look);
      c.fill();
    }

    function floor(project, cell) {
      const reach = (axis) => Math.max((group.high[axis] - group.low[axis]) / 2, 0.4 * group.radius);
      const low = group.centre.map((c, axis) => Math.floor((c - reach(axis)) / cell) * cell);
      const high = group.centre.map((c, axis) => Math.ceil((c + reach(axis)) / cell) * cell);
      context.strokeStyle = variable("rule");
      context.lineWidth = 1;
      for (const [axis, other] of [[0, 1], [1, 0]])
        for (let at = low[axis]; at <= high[axis] + cell / 2; at += cell) {
          const ends = [low[other], high[other]].map((edge) =>
            project(...(axis ? [edge, at] : [at, edge]), group.low[2]));
          trace(context, ends);
          context.stroke();
        }
    }

    function draw() {
      const ratio = devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
      if (!width) return;
      if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
        canvas.width = Math.round(width * ratio);
        canvas.height = Math.round(height * ratio);
      }
      context.setTransform(ratio, 0, 0, ratio, 0, 0);
      context.clearRect(0, 0, width, height);
      const cell = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50].find((c) => c > group.radius / 5) ?? 100;
      const now = frame();
      const shown = group.chains.filter((chain) => chain.shown).sort((a, b) => a.look - b.look);
      const columns = beside ? Math.max(shown.length, 1) : 1;
      for (let column = 0; column < columns; column++) {
        const project = projection(column, columns, width, height);
        floor(project, cell);
        for (const chain of beside ? shown.slice(column, column + 1) : shown) object(chain, project, now);
      }
      context.fillStyle = variable("quiet");
      context.font = "12px system-ui, sans-serif";
      context.fillText(`floor squares ${cell} m`, 12, height - 12);
    }

    function object(chain, project, now) {
      const at = points(chain, now), seen = at.map((point) => project(...point));
      if (chain.lines) { // no chain with a tip, but outlines, or many of them
        context.globalAlpha = chain.faint ? 0.35 : 1;
        stroke(context, chain.faint ? { ...chain, dash: [], width: 1 } : chain, seen);
        context.globalAlpha = 1;
        return;
      }
      context.globalAlpha = 0.18; // the shadow, which tells how high it hangs
      context.strokeStyle = variable("ink");
      context.lineWidth = 3;
      trace(context, at.map(([x, y, z]) => project(x, y, z - z + group.low[2])));
      context.stroke();

      context.globalAlpha = 0.25; // the tip's whole path, and boldly what it did just now
      context.strokeStyle = variable("series-" + chain.look);
      context.lineWidth = 1;
      trace(context, group.time.map((_, f) => project(...tip(chain, f))));
      context.stroke();
      context.lineWidth = 2;
      let from = project(...at[at.length - 1]);
      for (let f = now[0]; f >= 0 && time - group.time[f] <= TRAIL; f--) {
        const to = project(...tip(chain, f));
        context.globalAlpha = 0.8 * (1 - (time - group.time[f]) / TRAIL);
        trace(context, [from, to]);
        context.stroke();
        from = to;
      }
      context.globalAlpha = 1;

      stroke(context, chain, seen);
      const every = Math.max(1, Math.round(seen.length / 12));
      seen.forEach(([x, y], i) => { if ((seen.length - 1 - i) % every === 0) marker(context, chain, x, y, chain.width > 3 ? 4 : 3); });
      marker(context, chain, ...seen[seen.length - 1], 6);
    }

    // --- looking around
    let held = null; // where the pointer was last
    canvas.onpointerdown = (event) => { canvas.setPointerCapture(event.pointerId); held = [event.clientX, event.clientY]; };
    canvas.onpointerup = canvas.onpointercancel = () => { held = null; };
    canvas.onpointermove = (event) => {
      if (!held) return;
      turn((event.clientX - held[0]) * 0.008, (event.clientY - held[1]) * 0.008);
      held = [event.clientX, event.clientY];
    };
    canvas.onkeydown = (event) => {
      const turns = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] };
      if (event.key === " ") run(!playing);
      else if (turns[event.key]) turn(...turns[event.key]);
      else return;
      event.preventDefault();
    };
    function turn(aside, over) {
      yaw += aside;
      pitch = Math.min(Math.max(pitch + over, -0.2), 1.57);
      draw();
    }

    new ResizeObserver(draw).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { legend(); draw(); });
    choose(group);
    run(!matchMedia("(prefers-reduced-motion: reduce)").matches);
    new IntersectionObserver(([entry]) => { if (!entry.isIntersecting && playing) run(false); }).observe(canvas);
  }

  document.querySelectorAll(".player").forEach(player);
})();
