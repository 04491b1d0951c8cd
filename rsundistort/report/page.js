"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const byId = (id) => document.getElementById(id);
  const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  const drawings = [];  // drawn again when the colours change

  // ---------------------------------------------------------------- before and after

  let shown = 0;
  const views = data.views;

  function arrowsPath(view) {
    let path = "";
    for (const [x0, y0, x1, y1] of view.arrows) {
      const dx = (x1 - x0) * data.longer, dy = (y1 - y0) * data.longer, length = Math.hypot(dx, dy);
      if (length < 1.5) { path += `M${x0} ${y0}h0.01`; continue; }
      const x = x0 + dx, y = y0 + dy, head = Math.min(10, 0.4 * length) / length;
      const barb = (s) => `${(x - head * (dx + s * 0.55 * dy)).toFixed(1)} ${(y - head * (dy - s * 0.55 * dx)).toFixed(1)}`;
      path += `M${x0} ${y0}L${x.toFixed(1)} ${y.toFixed(1)}M${barb(1)}L${x.toFixed(1)} ${y.toFixed(1)}L${barb(-1)}`;
    }
    return path;
  }

  function setImage(image, address) {
    if (address) image.src = address; else image.removeAttribute("src");
  }

  function show(index) {
    shown = (index + views.length) % views.length;
    const view = views[shown], [width, height] = view.size, stage = byId("stage");
    stage.style.aspectRatio = `${width} / ${height}`;
    stage.style.maxWidth = `calc(78vh * ${width / height})`;
    stage.classList.toggle("single", !(view.before && view.after));
    setImage(byId("before"), view.before);
    setImage(byId("after"), view.after);
    byId("before").alt = `${view.name} before`;
    byId("after").alt = `${view.name} after`;
    byId("arrows").setAttribute("viewBox", `0 0 1000 ${1000 * height / width}`);
    byId("shafts").setAttribute("d", arrowsPath(view));
    byId("caption").textContent = view.shift === null ? "" : `shutter moved pixels by up to ${view.shift.toFixed(1)} px`;
    byId("choose").value = shown;
    for (const button of document.querySelectorAll("#strip button")) {
      const current = Number(button.dataset.index) === shown;
      button.setAttribute("aria-current", current);
      if (current) button.parentElement.scrollTo({
        left: button.offsetLeft - button.parentElement.offsetLeft - button.parentElement.clientWidth / 2 + button.clientWidth / 2,
      });
    }
  }

  function startViewer() {
    if (!views.length) return;
    const slider = byId("slider"), strip = byId("strip");
    slider.addEventListener("input", () => byId("stage").style.setProperty("--at", `${slider.value}%`));
    byId("previous").addEventListener("click", () => show(shown - 1));
    byId("next").addEventListener("click", () => show(shown + 1));
    byId("choose").addEventListener("change", (event) => show(Number(event.target.value)));
    byId("with-arrows").addEventListener("change", (event) => { byId("arrows").style.display = event.target.checked ? "" : "none"; });
    for (const link of document.querySelectorAll("a[data-photo]")) {
      const index = views.findIndex((view) => view.number === Number(link.dataset.photo));
      if (index < 0) link.removeAttribute("href"); else link.addEventListener("click", () => show(index));
    }
    if (strip) {
      // a picture is decoded when it comes into sight
      const watcher = new IntersectionObserver((entries) => {
        for (const entry of entries) if (entry.isIntersecting) {
          const view = views[Number(entry.target.dataset.index)];
          setImage(entry.target.firstChild, view.after || view.before);
          watcher.unobserve(entry.target);
        }
      }, {root: strip, rootMargin: "0px 300px"});
      views.forEach((view, index) => {
        const button = document.createElement("button"), image = document.createElement("img");
        button.type = "button";
        button.title = view.name;
        button.dataset.index = index;
        button.style.width = `${62 * view.size[0] / view.size[1]}px`;
        image.alt = view.name;
        button.append(image);
        button.addEventListener("click", () => show(index));
        strip.append(button);
        watcher.observe(button);
      });
    }
    // the photo that the shutter moved most says most
    show(views.reduce((best, view, index) => (view.shift || 0) > (views[best].shift || 0) ? index : best, 0));
  }

  // ---------------------------------------------------------------- table

  function startTables() {
    for (const table of document.querySelectorAll("table.sortable")) {
      const heads = [...table.tHead.rows[0].cells];
      heads.forEach((head, column) => head.querySelector("button")?.addEventListener("click", () => {
        const text = head.dataset.kind === "text";
        const down = head.getAttribute("aria-sort") === (text ? "ascending" : null) ||
          (!text && head.getAttribute("aria-sort") !== "descending");
        const key = (row) => {
          const cell = row.cells[row.cells.length === heads.length || column === 0 ? column : 1];
          const value = cell ? cell.dataset.value || "" : "";
          return text ? value : value === "" ? null : Number(value);
        };
        const compare = (a, b) => text ? a.localeCompare(b, undefined, {numeric: true}) : a - b;
        const rows = [...table.tBodies[0].rows].sort((one, other) => {
          const a = key(one), b = key(other);
          if (a === null || b === null) return (a === null) - (b === null);  // what has no value comes last
          return down ? compare(b, a) : compare(a, b);
        });
        for (const other of heads) other.removeAttribute("aria-sort");
        head.setAttribute("aria-sort", down ? "descending" : "ascending");
        table.tBodies[0].append(...rows);
      }));
    }
  }

  // ---------------------------------------------------------------- plots

  const quiet = {displayModeBar: false, responsive: true, scrollZoom: false, displaylogo: false};
  const axis = (title, more = {}) => ({
    title: {text: title, font: {size: 13}}, gridcolor: color("line"), zerolinecolor: color("line"), linecolor: color("line"),
    tickcolor: color("line"), automargin: true, fixedrange: true, ...more,
  });
  const layout = (more) => ({
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", showlegend: false, dragmode: false,
    font: {family: getComputedStyle(document.body).fontFamily, size: 12, color: color("soft")},
    margin: {l: 48, r: 8, t: 8, b: 40}, hoverlabel: {font: {family: "inherit", size: 13}}, ...more,
  });

  function plot(id, make) {
    if (!byId(id)) return;
    const draw = () => { const [traces, settings, options] = make(); return Plotly.react(id, traces, settings, {...quiet, ...options}); };
    drawings.push(draw);
  }

  const packed = (points) => {
    const arrays = {};
    for (const key of "xyz") arrays[key] = new Float32Array(Uint8Array.from(atob(points[key]), (c) => c.charCodeAt(0)).buffer);
    return arrays;
  };

  function startScene() {
    const scene = data.scene;
    if (!scene) return;
    const unpacked = new Map();
    const once = (points) => { if (!unpacked.has(points)) unpacked.set(points, packed(points)); return unpacked.get(points); };
    let which = "ours";
    plot("plot-scene", () => {
      const traces = [];
      const side = (of, name, tone, points, visible) => {
        if (points) traces.push({
          type: "scatter3d", mode: "markers", name: `points, ${name}`, ...once(of.points), visible, hoverinfo: "skip",
          marker: {size: 1.6, color: which === "ours" && name === "ours" && scene.colors.length ? scene.colors : color(tone), opacity: which === "both" ? 0.55 : 0.9},
        });
        traces.push({
          type: "scatter3d", mode: "lines", name: `frusta, ${name}`, ...once(of.frusta), visible, hoverinfo: "skip",
          line: {color: color(tone), width: 2}, connectgaps: false,
        });
        traces.push({
          type: "scatter3d", mode: "markers", name: `cameras, ${name}`, ...once(of.centers), visible, text: scene.names,
          hovertemplate: "%{text}<extra></extra>", marker: {size: 3, color: color(tone)},
        });
      };
      side(scene, "ours", "ours", scene.points, which !== "global");
      if (scene.global) side(scene.global, "global", "global", true, which !== "ours");
      const plain = {visible: false, showspikes: false};
      const [x, y, z] = scene.box;
      const spans = [x, y, z].map(([low, high]) => high - low), size = 2 / Math.hypot(...spans);
      // the field of view is that of the height: a narrow page needs more distance
      const {clientWidth: width, clientHeight: height} = byId("plot-scene"), far = Math.max(1, 1.9 * height / (width || 1));
      return [traces, layout({
        margin: {l: 0, r: 0, t: 0, b: 0}, dragmode: "orbit", uirevision: "kept",
        scene: {
          xaxis: {...plain, range: x}, yaxis: {...plain, range: y}, zaxis: {...plain, range: z}, aspectmode: "manual",
          aspectratio: {x: size * spans[0], y: size * spans[1], z: size * spans[2]},
          camera: {eye: {x: -0.25 * far, y: -1.55 * far, z: 0.85 * far}, up: {x: 0, y: 0, z: 1}},
        },
      }), {scrollZoom: true}];
    });
    const draw = drawings[drawings.length - 1];
    for (const button of document.querySelectorAll("[data-show]")) button.addEventListener("click", () => {
      which = button.dataset.show;
      for (const other of document.querySelectorAll("[data-show]")) other.setAttribute("aria-pressed", other === button);
      draw();
    });
  }

  function startSphere() {
    const scene = data.scene;
    if (!scene || !byId("plot-sphere")) return;
    const axes = packed(scene.axes), grid = {x: [], y: [], z: []}, ends = {x: [], y: [], z: []}, lines = {x: [], y: [], z: []};
    const put = (to, x, y, z) => { to.x.push(x); to.y.push(y); to.z.push(z); };
    for (let k = -2; k <= 2; k++) {  // parallels
      const z = Math.sin(k * Math.PI / 6), r = Math.cos(k * Math.PI / 6);
      for (let a = 0; a <= 72; a++) put(grid, r * Math.cos(a * Math.PI / 36), r * Math.sin(a * Math.PI / 36), z);
      put(grid, null, null, null);
    }
    for (let k = 0; k < 6; k++) {  // meridians
      for (let a = 0; a <= 72; a++) {
        const r = Math.cos(a * Math.PI / 36);
        put(grid, r * Math.cos(k * Math.PI / 6), r * Math.sin(k * Math.PI / 6), Math.sin(a * Math.PI / 36));
      }
      put(grid, null, null, null);
    }
    for (let i = 0; i < axes.x.length; i++) {
      const [x, y, z] = [axes.x[i], axes.y[i], axes.z[i]];
      for (const s of [1, -1]) put(ends, s * x, s * y, s * z);
      put(lines, x, y, z); put(lines, -x, -y, -z); put(lines, null, null, null);
    }
    const names = scene.names.flatMap((name) => [name, name]);
    plot("plot-sphere", () => [[
      {type: "scatter3d", mode: "lines", ...grid, hoverinfo: "skip", line: {color: color("line"), width: 1.5}},
      {type: "scatter3d", mode: "lines", ...lines, hoverinfo: "skip", line: {color: color("ours"), width: 2}, opacity: 0.45},
      {type: "scatter3d", mode: "markers", ...ends, text: names, hovertemplate: "%{text}<extra></extra>", marker: {size: 4.5, color: color("ours")}},
    ], layout({
      margin: {l: 0, r: 0, t: 0, b: 0}, dragmode: "orbit", uirevision: "kept",
      scene: {
        xaxis: {visible: false, range: [-1.05, 1.05]}, yaxis: {visible: false, range: [-1.05, 1.05]}, zaxis: {visible: false, range: [-1.05, 1.05]},
        aspectmode: "cube", camera: {eye: {x: 0.6, y: -1.35, z: 0.5}},
      },
    })]);
  }

  function startResiduals() {
    const residuals = data.residuals;
    if (!residuals) return;
    const middle = (edges) => edges.slice(1).map((edge, i) => (edge + edges[i]) / 2);
    plot("plot-histogram", () => [["global", "ours"].map((tone, k) => ({
      type: "scatter", mode: "lines", x: middle(residuals.edges), y: residuals.histogram[k], line: {color: color(tone), width: 2, shape: "hspline"},
      fill: "tozeroy", fillcolor: color(tone) + "22", hovertemplate: "%{x:.2f} px: %{y}<extra></extra>",
    })), layout({xaxis: axis("residual, px", {zeroline: false}), yaxis: axis("x and y parts", {rangemode: "tozero"})})]);
    plot("plot-rows", () => {
      const of = Number(byId("choose-rows").value), traces = [];
      ["global", "ours"].forEach((tone, k) => {
        const values = of < 0 ? [[residuals.rows[k], "solid", ""]] : [0, 1].map((part) =>
          [residuals.photo_rows[k][of].map((each) => each[part]), part ? "solid" : "dot", part ? "y " : "x "]);
        for (const [y, dash, part] of values) traces.push({
          type: "scatter", mode: of < 0 ? "lines" : "lines+markers", x: y.map((_, i) => 100 * (i + 0.5) / y.length), y,
          line: {color: color(tone), width: 2, dash}, marker: {size: 5}, hovertemplate: `${part}%{y:.3f} px at %{x:.0f} %<extra></extra>`,
        });
      });
      return [traces, layout({
        xaxis: axis("part of the readout, %", {range: [0, 100], zeroline: false}),
        yaxis: axis(of < 0 ? "rms, px" : "mean, px (x dotted, y solid)", {rangemode: of < 0 ? "tozero" : "normal"}),
      })];
    });
    const drawRows = drawings[drawings.length - 1];
    byId("choose-rows").addEventListener("change", drawRows);
    const cameraOf = () => Number(byId("choose-cells")?.value || 0);
    const longer = () => {
      let largest = 0;
      for (const k of [0, 1]) for (const row of residuals.cells[k][cameraOf()]) for (const [x, y] of row) if (x !== null) largest = Math.max(largest, Math.hypot(x, y));
      const cell = residuals.sizes[cameraOf()][0] / residuals.cells[0][cameraOf()][0].length, factor = 1.2 * cell / Math.max(largest, 1e-6);
      const ten = 10 ** Math.floor(Math.log10(factor));
      return Math.max(1, ten * (factor / ten >= 5 ? 5 : factor / ten >= 2 ? 2 : 1));
    };
    const drawCells = [];
    ["global", "ours"].forEach((tone, k) => {
      plot(`plot-cells-${tone}`, () => {
        const cells = residuals.cells[k][cameraOf()], [width, height] = residuals.sizes[cameraOf()], down = cells.length, across = cells[0].length;
        const x = [], y = [], heads = {x: [], y: [], text: []}, times = longer();
        cells.forEach((row, i) => row.forEach(([dx, dy], j) => {
          if (dx === null) return;
          const x0 = (j + 0.5) * width / across, y0 = (i + 0.5) * height / down;
          x.push(x0, x0 + times * dx, null); y.push(y0, y0 + times * dy, null);
          heads.x.push(x0); heads.y.push(y0); heads.text.push(`${Math.hypot(dx, dy).toFixed(3)} px`);
        }));
        byId("cells-longer").textContent = `vectors × ${times}`;
        return [[
          {type: "scatter", mode: "lines", x, y, hoverinfo: "skip", line: {color: color(tone), width: 2}},
          {type: "scatter", mode: "markers", ...heads, hovertemplate: "%{text}<extra></extra>", marker: {size: 4, color: color(tone)}},
        ], layout({
          margin: {l: 6, r: 6, t: 6, b: 6},
          shapes: [{type: "rect", x0: 0, y0: 0, x1: width, y1: height, line: {color: color("line"), width: 1}}],
          xaxis: {visible: false, range: [-0.04 * width, 1.04 * width], fixedrange: true, constrain: "domain"},
          yaxis: {visible: false, range: [1.04 * height, -0.04 * height], fixedrange: true, scaleanchor: "x", constrain: "domain"},
        })];
      });
      drawCells.push(drawings[drawings.length - 1]);
    });
    byId("choose-cells")?.addEventListener("change", () => drawCells.forEach((draw) => draw()));
  }

  startViewer();
  startTables();
  startScene();
  startSphere();
  startResiduals();
  const drawAll = async () => {
    for (const draw of drawings) {  // one at a time: the page stays alive
      try { await draw(); } catch (error) { console.error(error); }
      await new Promise((done) => setTimeout(done));
    }
    document.documentElement.dataset.drawn = "yes";
  };
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawAll);
  drawAll();
})();
