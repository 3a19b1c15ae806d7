// Draw charts when they come into view, sort tables, expand groups of rows, and open the section that a link points to.
(() => {
  const config = {
    background: null, font: "system-ui, 'DejaVu Sans', sans-serif", view: { stroke: null },
    axis: { labelColor: "var(--text)", titleColor: "var(--note)", gridColor: "var(--line)", domainColor: "var(--faint)",
      tickColor: "var(--faint)", titleFontWeight: 400, labelFontSize: 11, titleFontSize: 11, grid: true },
    axisQuantitative: { labelOverlap: "greedy", labelSeparation: 6 }, axisBand: { grid: false }, legend: { labelColor: "var(--text)", titleColor: "var(--text)", labelFontSize: 11, rowPadding: 2 },
    header: { labelColor: "var(--text)", labelFontSize: 12 },
  };
  const tip = document.getElementById("tip");
  const showTip = (handler, event, item, value) => {
    if (value == null || value === "") { tip.style.display = "none"; return; }
    tip.replaceChildren();
    const rows = typeof value === "object" ? Object.entries(value) : [[" ", value]];
    for (const [name, text] of rows) {
      if (text == null || text === "" || text === "null") continue;
      const line = document.createElement("div");
      const bold = document.createElement(name.trim() ? "span" : "b");
      bold.textContent = name.trim() ? `${name}: ${text}` : text;
      line.append(bold);
      tip.append(line);
    }
    tip.style.display = "block";
    tip.style.left = `${Math.min(event.clientX + 14, innerWidth - tip.offsetWidth - 6)}px`;
    tip.style.top = `${Math.min(event.clientY + 14, innerHeight - tip.offsetHeight - 6)}px`;
  };

  // ast: expressions are interpreted, because the page's policy forbids code that is made from text
  const options = { ast: true, renderer: "svg", actions: false, defaultStyle: false, config, tooltip: showTip };
  const embed = async (plot, spec) => {
    plot.view?.finalize();
    plot.view = (await vegaEmbed(plot, spec, options)).view;
    return plot.querySelector("svg");
  };
  const unpack = (spec) => { // the page stores tables by column
    if (Array.isArray(spec)) return spec.map(unpack);
    if (spec === null || typeof spec !== "object") return spec;
    if (!("columns" in spec && "rows" in spec)) return Object.fromEntries(Object.entries(spec).map(([key, part]) => [key, unpack(part)]));
    const values = Array.from({ length: spec.rows }, () => ({}));
    for (const [name, column] of Object.entries(spec.columns)) {
      const plain = Array.isArray(column);
      values.forEach((row, index) => {
        const value = plain ? column[index] : column.of[Array.isArray(column.at) ? column.at[index] : column.at];
        if (value !== null || name === "y" || name === "x") row[name] = value;
      });
    }
    return { values };
  };
  const draw = (plot) => {
    const room = plot.clientWidth;
    if (!room || plot.drawn === room) return plot.done;
    plot.drawn = room;
    plot.done = drawIn(plot, room);
    return plot.done;
  };
  const drawIn = async (plot, room) => {
    const spec = unpack(JSON.parse(plot.parentElement.querySelector("script").textContent));
    const about = spec.usermeta ?? {};
    delete spec.usermeta;
    const wide = Math.min(room, about.most ?? room);
    let svg;
    if (!spec.facet) {
      svg = await embed(plot, { ...spec, width: wide, autosize: { type: "fit-x", contains: "padding" } });
    } else {
      const size = (width) => { spec.spec.width = Math.max(70, width); };
      size(wide - 14);
      for (let round = 0; round < 3; round += 1) { // the width of the labels is known only after drawing
        svg = await embed(plot, spec);
        const over = svg.getBoundingClientRect().width - wide;
        if (over <= 0.5 && over > -2) break;
        size(spec.spec.width - over - 1);
      }
    }
    svg.setAttribute("role", "img");
    svg.setAttribute("aria-label", plot.dataset.title);
    plot.dataset.ready = "yes";
  };
  const plots = [...document.querySelectorAll(".plot")];
  const observer = new IntersectionObserver((entries) => entries.forEach((entry) => { if (entry.isIntersecting) draw(entry.target); }),
    { rootMargin: "400px" });
  plots.forEach((plot) => observer.observe(plot));
  let redraw;
  addEventListener("resize", () => { clearTimeout(redraw); redraw = setTimeout(() => plots.filter((plot) => plot.drawn).forEach(draw), 120); });
  const showAll = () => {
    document.querySelectorAll("details").forEach((details) => { details.open = true; });
    return Promise.all(plots.map(draw));
  };
  addEventListener("beforeprint", showAll);
  window.showAll = showAll;
  window.drawn = () => Promise.all(plots.filter((plot) => plot.getBoundingClientRect().top < innerHeight && plot.clientWidth).map(draw));

  for (const table of document.querySelectorAll("table")) {
    table.tHead?.addEventListener("click", (event) => {
      const head = event.target.closest("th");
      if (!head) return;
      const column = head.cellIndex;
      const descending = head.getAttribute("aria-sort") !== "descending";
      table.querySelectorAll("thead th").forEach((header) => header.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", descending ? "descending" : "ascending");
      const key = (row) => { const cell = row.cells[column]; const value = parseFloat(cell?.dataset.value); return isNaN(value) ? cell?.textContent ?? "" : value; };
      const compare = (a, b) => {
        const [x, y] = [key(a), key(b)];
        if (typeof x !== typeof y) return typeof x === "number" ? -1 : 1; // numbers come first
        const order = typeof x === "number" ? x - y : x.localeCompare(y);
        return descending === (typeof x === "number") ? -order : order;
      };
      for (const body of table.tBodies) {
        const rows = [...body.rows].filter((row) => !row.classList.contains("group"));
        rows.sort(compare).forEach((row) => { row.hidden = false; row.classList.remove("more"); body.append(row); });
        body.querySelectorAll("button.more").forEach((button) => button.remove());
      }
    });
  }
  document.addEventListener("click", (event) => {
    const more = event.target.closest("button.more");
    if (more) {
      const open = more.getAttribute("aria-expanded") !== "true";
      more.setAttribute("aria-expanded", open);
      let row = more.closest("tr").nextElementSibling;
      for (; row?.classList.contains("more"); row = row.nextElementSibling) row.hidden = !open;
    }
    const copied = event.target.closest("[data-copy]");
    if (copied) navigator.clipboard?.writeText(copied.dataset.copy || copied.textContent);
  });
  const openTarget = () => {
    const target = document.getElementById(location.hash.slice(1));
    for (let element = target; element; element = element.parentElement) if (element.tagName === "DETAILS") element.open = true;
    target?.scrollIntoView();
  };
  addEventListener("hashchange", openTarget);
  openTarget();
  document.querySelectorAll("nav details").forEach((details) => { details.open = innerWidth > 860; });
})();
