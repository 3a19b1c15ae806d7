// What of a page a reader sees wrong: returns sentences, none where all is well.
(() => {
  const SLACK = 1.5; // CSS pixels: rounding, and what letters' side bearings take
  const found = new Set();
  const seen = (element) => {
    const box = element.getBoundingClientRect();
    const style = getComputedStyle(element);
    return box.width > 0 && box.height > 0 && style.visibility !== "hidden" && style.display !== "none";
  };
  const short = (text) => text.trim().replace(/\s+/g, " ").slice(0, 80);

  // 1. text as rendered, words that no reader should meet
  const wrong = [
    ["raw mathtext", /\$\\|\\math|\\times|\\frac|\$[^$ ]*\^\{/],
    ["raw HTML", /&(?:lt|gt|amp|nbsp|quot|#\d+);|<\/?(?:b|i|br|p|small|span|td|tr|sub|sup|strong)\b[^>]*>/],
    ["None", /(?<![\w.])None(?![\w])/],
    ["a format leftover", /\{[A-Za-z_][\w.]*(?:![rsa])?(?::[^{}"]*)?\}|%[sdf]\b|%\.\df/],
    ["a number that is none", /(?<![\w])[+\-\u2212]?(?:nan|inf|infinity)(?![\w])/i],
  ];
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node = walker.nextNode(); node; node = walker.nextNode()) {
    const parent = node.parentElement;
    if (!node.data.trim() || ["STYLE", "SCRIPT", "TITLE", "DESC", "DEFS"].includes(parent.tagName.toUpperCase())) continue;
    if (!seen(parent)) continue;
    for (const [what, pattern] of wrong) {
      if (pattern.test(node.data)) found.add(`${what}: ${short(node.data)}`);
    }
  }
  // text that is split over elements is read once more as the browser joins it
  for (const [what, pattern] of wrong) {
    const whole = document.body.innerText.match(pattern);
    if (whole) found.add(`${what}: ${short(whole[0])}`);
  }

  // 2. nothing wider than the window
  const width = document.documentElement.clientWidth;
  if (document.documentElement.scrollWidth > width) {
    const widest = [...document.body.querySelectorAll("*")]
      .filter((one) => one.getBoundingClientRect().right > width + SLACK && !one.closest(".scroll > *"))
      .map((one) => one.tagName.toLowerCase());
    found.add(`wider than ${width} px: ${document.documentElement.scrollWidth} px (${[...new Set(widest)].join(", ")})`);
  }

  // 3. text cut by its box: what overflows where nothing scrolls
  for (const one of document.body.querySelectorAll("*:not(svg):not(svg *)")) {
    const style = getComputedStyle(one);
    const cutX = ["hidden", "clip"].includes(style.overflowX) && one.scrollWidth > one.clientWidth + SLACK;
    const cutY = ["hidden", "clip"].includes(style.overflowY) && one.scrollHeight > one.clientHeight + SLACK;
    if (one.clientWidth && (cutX || cutY)) found.add(`cut by its box: ${short(one.innerText || one.tagName)}`);
  }

  // 4. text of figures: within the figure, and not over other text
  for (const svg of document.querySelectorAll("svg")) {
    const frame = svg.getBoundingClientRect();
    if (!frame.width) continue;
    const label = svg.getAttribute("aria-label") || "a figure";
    const boxes = [...svg.querySelectorAll("text")].filter((one) => one.textContent.trim() && one.getAttribute("opacity") !== "0").map((one) => {
      const box = one.getBoundingClientRect();
      return { text: short(one.textContent), left: box.left, right: box.right, top: box.top, bottom: box.bottom,
               turned: /rotate\((?!0[ )])/.test(one.getAttribute("transform") || "") };
    });
    for (const one of boxes) {
      const out = Math.max(frame.left - one.left, one.right - frame.right, frame.top - one.top, one.bottom - frame.bottom);
      if (out > SLACK) found.add(`outside its figure (${label}) by ${out.toFixed(0)} px: ${one.text}`);
    }
    for (let i = 0; i < boxes.length; i++) {
      for (let j = i + 1; j < boxes.length; j++) {
        const [a, b] = [boxes[i], boxes[j]];
        const across = Math.min(a.right, b.right) - Math.max(a.left, b.left);
        const down = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
        const high = Math.min(a.bottom - a.top, b.bottom - b.top);
        // a line's box holds room above and below its letters: only what overlaps by more than that hides text
        if (across > SLACK && down > 0.35 * high) found.add(`over each other (${label}): "${a.text}" and "${b.text}"`);
      }
    }
  }
  // 5. charts: each that has room is drawn and shows something
  for (const plot of document.querySelectorAll(".plot")) {
    if (!plot.clientWidth || plot.getBoundingClientRect().top > innerHeight && !plot.drawn) continue;
    const title = plot.dataset.title;
    if (!plot.querySelector("svg")) found.add(`a chart that is not drawn: ${title}`);
    else if (!plot.querySelector(".role-mark path[d], .role-mark text, .role-mark line")) found.add(`an empty chart: ${title}`);
    if (plot.scrollWidth > plot.clientWidth + SLACK) found.add(`a chart wider than its column: ${title}`);
    for (const point of plot.querySelectorAll(".mark-symbol.role-mark path[d]")) {
      const area = point.closest("[clip-path]") && point.closest(".mark-group")?.querySelector("path.background");
      if (!area) continue;
      const [frame, box] = [area.getBoundingClientRect(), point.getBoundingClientRect()];
      const out = Math.max(frame.left - box.left, box.right - frame.right, frame.top - box.top, box.bottom - frame.bottom);
      if (out > SLACK) found.add(`a point cut by its chart: ${title}`);
    }
    for (const text of plot.querySelectorAll("svg text")) {
      if (text.textContent.endsWith("\u2026")) found.add(`a text cut in a chart (${title}): ${short(text.textContent)}`);
    }
    for (const axis of plot.querySelectorAll(`[aria-label^="X-axis titled 'epoch'"]`)) {
      const ticks = [...axis.querySelectorAll(".role-axis-label text")].map((text) => text.textContent);
      if (ticks.some((text) => text.includes("."))) found.add(`epochs that are not whole (${title}): ${ticks.join(" ")}`);
    }
  }
  return [...found].sort();
})()
