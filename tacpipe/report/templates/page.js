// Charts drawn where they come into view, tables that sort, families that unfold, and links that open their fold.
(() => {
  const config = {
    background: null, font: "system-ui, 'DejaVu Sans', sans-serif", view: { stroke: null },
    axis: { labelColor: "var(--text)", titleColor: "var(--note)", gridColor: "var(--line)", domainColor: "var(--faint)",
      tickColor: "var(--faint)", titleFontWeight: 400, labelFontSize: 11, titleFontSize: 11, grid: true },
    axisQuantitative: { labelOverlap: "greedy", labelSeparation: 6 }, axisBand: { grid: false }, legend: { labelColor: "var(--text)", titleColor: "var(--text)", labelFontSize: 11, rowPadding: 2 },
    header: { labelColor: "var(--text)", labelFontSize: 12 },
  };
  const tip = document.getElementById("tip");
  const tell = (handler, event, item, value) => {
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

  const options = { renderer: "svg", actions: false, defaultStyle: false, config, tooltip: tell };
  const view = async (plot, spec) => {
    plot.view?.finalize();
    plot.view = (await vegaEmbed(plot, spec, options)).view;
    return plot.querySelector("svg");
  };
  const unpack = (spec) => { // data come by column
    if (Array.isArray(spec)) return spec.map(unpack);
    if (spec === null || typeof spec !== "object") return spec;
    if (!("columns" in spec && "rows" in spec)) return Object.fromEntries(Object.entries(spec).map(([key, one]) => [key, unpack(one)]));
    const values = Array.from({ length: spec.rows }, () => ({}));
    for (const [name, column] of Object.entries(spec.columns)) {
      const whole = Array.isArray(column);
      values.forEach((row, place) => {
        const value = whole ? column[place] : column.of[Array.isArray(column.at) ? column.at[place] : column.at];
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
      svg = await view(plot, { ...spec, width: wide, autosize: { type: "fit-x", contains: "padding" } });
    } else {
      if (spec.columns) spec.columns = Math.max(1, Math.min(spec.columns, Math.floor(room / (about.least ?? 190))));
      const columns = spec.columns ?? 1;
      const size = (width) => { spec.spec.width = Math.max(70, width); if (about.tall) spec.spec.height = spec.spec.width * about.tall; };
      size(Math.min(wide / columns - 14, about.panel ?? 1e4));
      for (let round = 0; round < 3; round += 1) { // labels take room that is known once they are drawn
        svg = await view(plot, spec);
        const over = svg.getBoundingClientRect().width - wide;
        if (over <= 0.5 && (over > -2 || about.panel)) break;
        size(spec.spec.width - over / columns - 1);
      }
    }
    svg.setAttribute("role", "img");
    svg.setAttribute("aria-label", plot.dataset.title);
    plot.dataset.ready = "yes";
  };
  const plots = [...document.querySelectorAll(".plot")];
  const seen = new IntersectionObserver((found) => found.forEach((one) => { if (one.isIntersecting) draw(one.target); }),
    { rootMargin: "400px" });
  plots.forEach((one) => seen.observe(one));
  let later;
  addEventListener("resize", () => { clearTimeout(later); later = setTimeout(() => plots.filter((one) => one.drawn).forEach(draw), 120); });
  const all = () => {
    document.querySelectorAll("details").forEach((one) => { one.open = true; });
    return Promise.all(plots.map(draw));
  };
  addEventListener("beforeprint", all);
  window.showAll = all;
  window.drawn = () => Promise.all(plots.filter((one) => one.getBoundingClientRect().top < innerHeight && one.clientWidth).map(draw));

  for (const table of document.querySelectorAll("table")) {
    table.tHead?.addEventListener("click", (event) => {
      const head = event.target.closest("th");
      if (!head) return;
      const column = head.cellIndex;
      const falls = head.getAttribute("aria-sort") !== "descending";
      table.querySelectorAll("thead th").forEach((one) => one.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", falls ? "descending" : "ascending");
      const key = (row) => { const cell = row.cells[column]; const value = parseFloat(cell?.dataset.value); return isNaN(value) ? cell?.textContent ?? "" : value; };
      const less = (a, b) => {
        const [x, y] = [key(a), key(b)];
        if (typeof x !== typeof y) return typeof x === "number" ? -1 : 1; // what has no number comes last
        const order = typeof x === "number" ? x - y : x.localeCompare(y);
        return falls === (typeof x === "number") ? -order : order;
      };
      for (const body of table.tBodies) {
        const rows = [...body.rows].filter((row) => !row.classList.contains("group"));
        rows.sort(less).forEach((row) => { row.hidden = false; row.classList.remove("more"); body.append(row); });
        body.querySelectorAll("button.more").forEach((one) => one.remove());
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
  const follow = () => {
    const place = document.getElementById(location.hash.slice(1));
    for (let one = place; one; one = one.parentElement) if (one.tagName === "DETAILS") one.open = true;
    place?.scrollIntoView();
  };
  addEventListener("hashchange", follow);
  follow();
  document.querySelectorAll("nav details").forEach((one) => { one.open = innerWidth > 860; });
})();
