"use strict";
(() => {
  const root = document.documentElement;
  const data = JSON.parse(document.getElementById("data").textContent);
  const controls = document.getElementById("controls");
  const tabs = [...document.querySelectorAll("[role=tab]")];
  const panels = tabs.map((tab) => document.getElementById(tab.getAttribute("aria-controls")));
  const tables = [...document.querySelectorAll("table.scores")];
  const original = new Map(
    tables.map((t) => [t, [...t.tBodies].map((body) => [...body.querySelectorAll("tr.row")])]),
  );
  const defaults = {
    family: tabs[0].dataset.family, protocol: controls.elements.protocol[0]?.value
      ?? controls.elements.protocol.value,
    columns: "main", q: "", guarantee: "", time: "", sort: "rank", direction: "ascending",
  };
  const state = { ...defaults };

  root.classList.add("js");
  for (const element of document.querySelectorAll(".tabs, #controls, #theme, .play")) {
    element.hidden = false;
  }

  // Light and dark: what the system says, until the button says otherwise.
  const button = document.getElementById("theme");
  const system = matchMedia("(prefers-color-scheme: dark)");
  const remembered = (value) => {
    try {
      if (value) localStorage.setItem("iflow-gym-theme", value);
      return localStorage.getItem("iflow-gym-theme");
    } catch {
      return value ?? null;
    }
  };
  const paint = (theme) => {
    root.dataset.theme = theme;
    button.textContent = theme === "dark" ? "Light colours" : "Dark colours";
  };
  paint(remembered() ?? (system.matches ? "dark" : "light"));
  system.addEventListener("change", () => {
    if (!remembered()) paint(system.matches ? "dark" : "light");
  });
  button.addEventListener("click", () => {
    const theme = root.dataset.theme === "dark" ? "light" : "dark";
    remembered(theme);
    paint(theme);
  });

  // The address says what is shown, so that a link opens the same view.
  function read() {
    const given = new URLSearchParams(location.hash.slice(1));
    for (const name of Object.keys(defaults)) state[name] = given.get(name) ?? defaults[name];
    if (!tabs.some((tab) => tab.dataset.family === state.family)) state.family = defaults.family;
    if (!["ascending", "descending"].includes(state.direction)) state.direction = "ascending";
    for (const name of ["protocol", "columns", "guarantee", "time", "q"]) {
      const field = controls.elements[name];
      if (field.tagName !== "INPUT") field.value = state[name];
      else if (field.type === "radio") field.checked = field.value === state[name];
      else field.value = state[name];
      if (["guarantee", "time"].includes(name)) state[name] = field.value;
    }
  }
  function write() {
    const given = new URLSearchParams();
    for (const [name, value] of Object.entries(state)) {
      if (value !== defaults[name]) given.set(name, value);
    }
    const text = given.toString();
    history.replaceState(null, "", text ? `#${text}` : location.pathname + location.search);
  }

  function show() {
    tabs.forEach((tab, i) => {
      const chosen = tab.dataset.family === state.family;
      tab.setAttribute("aria-selected", String(chosen));
      tab.tabIndex = chosen ? 0 : -1;
      panels[i].hidden = !chosen;
    });
    const panel = panels[tabs.findIndex((tab) => tab.dataset.family === state.family)];
    const boards = [...panel.querySelectorAll(".board")];
    const there = boards.map((board) => board.dataset.protocol);
    const protocol = there.includes(state.protocol) ? state.protocol : there[0];
    for (const board of boards) board.hidden = board.dataset.protocol !== protocol;
    for (const input of controls.querySelectorAll("[name=protocol]")) {
      input.disabled = !there.includes(input.value);
      input.checked = input.value === protocol;
    }
    if (!controls.querySelector("[name=columns]:checked")) {
      state.columns = defaults.columns;
      controls.querySelector("[name=columns]").checked = true;
    }
    for (const table of tables) {
      table.dataset.columns = state.columns;
      filter(table);
      sort(table);
    }
    const table = boards.find((board) => !board.hidden).querySelector("table.scores");
    const rows = [...table.querySelectorAll("tr.row")];
    const n = rows.filter((row) => !row.hidden).length;
    const words = `${n} of ${rows.length} rows`;
    const count = document.getElementById("count");
    if (count.textContent !== words) count.textContent = words;
  }

  function filter(table) {
    const wanted = state.q.trim().toLowerCase();
    let n = 0;
    for (const row of table.querySelectorAll("tr.row")) {
      const { method, title, guarantees, time } = row.dataset;
      row.hidden =
        (wanted && !title.includes(wanted) && !method.includes(wanted)) ||
        (state.guarantee && !guarantees.split(" ").includes(state.guarantee)) ||
        (state.time && time !== state.time) || false;
      if (!row.hidden) n += 1;
      const details = row.nextElementSibling;
      if (details?.classList.contains("details")) {
        details.hidden = row.hidden || !isOpen(row);
      }
    }
    for (const body of table.tBodies) {
      const group = body.querySelector("tr.group");
      if (group) group.hidden = !body.querySelector("tr.row:not([hidden])");
    }
    table.closest(".board").querySelector(".empty").hidden = n > 0;
  }

  function sort(table) {
    const heads = [...table.tHead.rows[0].cells];
    const found = heads.findIndex((h) => h.firstElementChild.dataset.sort === state.sort);
    const place = found >= 0 ? found : heads.findIndex((h) => h.firstElementChild.dataset.sort === "rank");
    heads.forEach((head, i) => {
      if (i === place) head.setAttribute("aria-sort", found >= 0 ? state.direction : "ascending");
      else head.removeAttribute("aria-sort");
    });
    const sign = found >= 0 && state.direction === "descending" ? -1 : 1;
    const key = (row) => row.cells[place].dataset.v;
    const compare = (a, b) => {
      const [x, y] = [key(a), key(b)];
      if (x === "" || y === "") return (x === "") - (y === ""); // what has no number comes last
      if (place === 0) return sign * x.localeCompare(y, "en");
      return Number(x) === Number(y) ? 0 : sign * (Number(x) < Number(y) ? -1 : 1);
    };
    [...table.tBodies].forEach((body, i) => {
      const sorted = [...original.get(table)[i]].sort(compare);
      const now = [...body.querySelectorAll("tr.row")];
      if (sorted.every((row, j) => row === now[j])) return;
      for (const row of sorted) {
        const next = row.nextElementSibling;
        body.append(row);
        if (next?.classList.contains("details")) body.append(next);
      }
    });
  }

  function change(name, value) {
    state[name] = value;
    write();
    show();
  }
  tabs.forEach((tab, i) => {
    tab.addEventListener("click", () => change("family", tab.dataset.family));
    tab.addEventListener("keydown", (event) => {
      const to = { ArrowRight: i + 1, ArrowLeft: i - 1, Home: 0, End: tabs.length - 1 }[event.key];
      if (to === undefined) return;
      event.preventDefault();
      const next = tabs[(to + tabs.length) % tabs.length];
      change("family", next.dataset.family);
      next.focus();
    });
  });
  controls.addEventListener("submit", (event) => event.preventDefault());
  controls.addEventListener("input", (event) => change(event.target.name, event.target.value));
  for (const table of tables) {
    table.tHead.addEventListener("click", (event) => {
      const head = event.target.closest(".sort");
      if (!head) return;
      const { sort: name, first = "ascending" } = head.dataset;
      const now = head.parentElement.getAttribute("aria-sort");
      const other = now === "ascending" ? "descending" : "ascending";
      state.direction = now ? other : first;
      change("sort", name);
    });
    table.addEventListener("click", (event) => {
      const opener = event.target.closest(".open");
      if (opener) toggle(opener.closest("tr"));
      const badge = event.target.closest(".badge");
      if (badge) explain(badge);
    });
  }

  // A row's details, written when it is opened.
  function isOpen(row) {
    return row.querySelector(".open").getAttribute("aria-expanded") === "true";
  }
  function element(name, text, attributes = {}) {
    const made = document.createElement(name);
    if (text !== undefined) made.textContent = text;
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    return made;
  }
  function list(pairs, many = false) {
    const made = element("dl", undefined, { class: many ? "facts many" : "facts" });
    for (const [term, text, address] of pairs) {
      const pair = [element("dt", term), element("dd", address ? undefined : text)];
      if (address) {
        pair[1].append(element("a", text, { href: address, target: "_blank", rel: "noopener" }));
      }
      if (many) {
        const together = element("div");
        together.append(...pair);
        made.append(together);
      } else made.append(...pair);
    }
    return made;
  }
  function toggle(row) {
    const opener = row.querySelector(".open");
    const open = !isOpen(row);
    opener.setAttribute("aria-expanded", String(open));
    let details = row.nextElementSibling;
    if (!details?.classList.contains("details")) {
      const id = `details-${row.closest("table").dataset.board}-${row.dataset.method}`;
      details = element("tr", undefined, { class: "details", id });
      const cell = element("td", undefined, { colspan: row.cells.length });
      cell.append(inside(data[row.closest("table").dataset.board][row.dataset.method]));
      details.append(cell);
      row.after(details);
      opener.setAttribute("aria-controls", id);
    }
    details.hidden = !open;
    fit();
  }
  function inside(known) {
    const made = element("div", undefined, { class: "inside" });
    made.append(list(known.facts));
    if (known.guarantees.length) made.append(element("h4", "Guarantee"), list(known.guarantees));
    made.append(element("h4", "Cells without scores"));
    if (known.missing.length) made.append(list(known.missing));
    else made.append(element("p", "None: every cell has scores."));
    if (known.settings.length) made.append(element("h4", "Settings"), list(known.settings, true));
    made.append(element("h4", "Every motion that was run"));
    made.append(element("p",
      "Means over the seeds. Below: 95 % bootstrap interval over the demonstrations; of what has " +
      "one number a cell, the least and the greatest of the seeds.", { class: "footnote" }));
    const scroll = element("div", undefined,
      { class: "scroll", tabindex: "0", role: "region", "aria-label": "Every motion's scores" });
    const table = element("table");
    const head = table.createTHead().insertRow();
    head.append(element("th", "Motion", { scope: "col" }));
    for (const title of known.metrics) head.append(element("th", title, { scope: "col" }));
    const body = table.createTBody();
    for (const [name, ...cells] of known.scores) {
      const line = body.insertRow();
      line.append(element("th", name, { scope: "row" }));
      for (const cell of cells) {
        const [text, interval] = Array.isArray(cell) ? cell : [cell];
        const entry = element("td", text);
        if (interval) entry.append(element("small", interval));
        line.append(entry);
      }
    }
    scroll.append(table);
    made.append(scroll);
    watch(scroll);
    return made;
  }
  function fit() {
    for (const made of document.querySelectorAll(".inside")) {
      const width = made.closest(".scroll").clientWidth;
      if (width) made.style.setProperty("--inside", `${width}px`);
    }
  }
  addEventListener("resize", fit);

  // What is wider than its place says so above, and fades out where there is more of it.
  const sizes = new ResizeObserver((entries) => {
    const areas = new Set(entries.map((entry) => entry.target.closest(".scroll")));
    requestAnimationFrame(() => areas.forEach(hint));
  });
  function watch(area) {
    const line = element("p", "Scroll sideways for the rest \u2192", { class: "sideways" });
    line.hidden = true;
    area.before(line);
    area.addEventListener("scroll", () => hint(area), { passive: true });
    sizes.observe(area);
    for (const child of area.children) sizes.observe(child);
  }
  function hint(area) {
    const rest = area.scrollWidth - area.clientWidth;
    area.previousElementSibling.hidden = rest <= 1;
    area.classList.toggle("more", rest - area.scrollLeft > 1);
  }
  for (const area of document.querySelectorAll(".scroll")) watch(area);

  // Why a guarantee is what it is.
  const reason = document.getElementById("reason");
  let asked = null;
  function explain(badge) {
    reason.textContent = `${badge.textContent}: ${badge.dataset.reason}`;
    if (!reason.showPopover) {
      alert(reason.textContent);
      return;
    }
    asked = badge;
    reason.showPopover({ source: badge });
    place();
  }
  function place() {
    if (!asked || !reason.matches(":popover-open")) return;
    const box = asked.getBoundingClientRect();
    const left = Math.max(8, Math.min(box.left, innerWidth - reason.offsetWidth - 8));
    const below = box.bottom + 6 + reason.offsetHeight < innerHeight;
    reason.style.left = `${left}px`;
    reason.style.top = `${below ? box.bottom + 6 : Math.max(8, box.top - 6 - reason.offsetHeight)}px`;
  }
  addEventListener("scroll", place, true);

  for (const play of document.querySelectorAll(".play")) {
    const image = play.closest("figure").querySelector("img");
    play.addEventListener("click", () => {
      const moving = play.getAttribute("aria-pressed") !== "true";
      play.setAttribute("aria-pressed", String(moving));
      play.textContent = moving ? "Stop" : "Play";
      image.src = moving ? image.dataset.moving : image.dataset.still;
    });
  }

  function start() {
    read();
    show();
    fit();
  }
  addEventListener("hashchange", start);
  start();
})();
