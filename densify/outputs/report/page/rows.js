// SPDX-License-Identifier: MIT
// A table of thousands of rows, of which only those in view are in the document.

const ROW_PX = 44;

class Rows {
  // columns: [{name, text, number, of, cell}]; of: row -> value to sort by; cell: row -> node.
  constructor(columns, choose) {
    Object.assign(this, { columns, choose, sorted: { column: 0, down: false }, alive: new Map() });
    this.heads = columns.map((column, at) => {
      const label = column.of ? element("button", { type: "button", onclick: () => this.sort(at) }, column.text) : column.text;
      return element("div", { role: "columnheader", class: column.number ? "number" : "" }, label);
    });
    $("head").replaceChildren(...this.heads);
    $("body").addEventListener("scroll", () => this.show());
    $("body").addEventListener("keydown", (e) => {
      const by = { PageDown: 12, PageUp: -12, ArrowDown: 1, ArrowUp: -1, Home: -1e6, End: 1e6 }[e.key];
      if (!by || e.target !== $("body")) return;
      e.preventDefault();
      $("body").scrollTop += by * ROW_PX;
    });
    new ResizeObserver(() => this.show()).observe($("body"));
  }
  sort(at) {
    const { column, down } = this.sorted;
    this.sorted = { column: at, down: column === at ? !down : !!this.columns[at].number };
    this.fill(this.rows);
  }
  fill(rows) {
    const { column, down } = this.sorted, { of } = this.columns[column];
    const keyed = rows.map((row) => [of(row), row]), missing = (v) => v === null || v === undefined;
    keyed.sort(([a], [b]) => {
      if (missing(a) || missing(b)) return missing(a) - missing(b);
      const order = typeof a === "string" ? (a < b ? -1 : a > b ? 1 : 0) : a - b;
      return down ? -order : order;
    });
    this.rows = keyed.map(([, row]) => row);
    this.heads.forEach((head, i) => {
      if (!this.columns[i].of) return;
      head.setAttribute("aria-sort", i !== column ? "none" : down ? "descending" : "ascending");
    });
    $("table").setAttribute("aria-rowcount", rows.length + 1);
    $("space-of-rows").style.height = `${ROW_PX * rows.length}px`;
    for (const made of this.alive.values()) made.remove();
    this.alive.clear();
    this.show();
  }
  show() {
    if (!this.rows) return;
    const body = $("body"), first = Math.max(0, Math.floor(body.scrollTop / ROW_PX) - 4);
    const last = Math.min(this.rows.length, first + Math.ceil(body.clientHeight / ROW_PX) + 8);
    for (const [at, made] of this.alive) {
      if (at < first || at >= last) {
        made.remove();
        this.alive.delete(at);
      }
    }
    for (let at = first; at < last; at++) {
      if (this.alive.has(at)) continue;
      const made = element("div", { role: "row", "aria-rowindex": at + 2 });
      made.style.top = `${ROW_PX * at}px`;
      for (const column of this.columns) {
        made.append(element("div", { role: "cell", class: column.number ? "number" : "" }, column.cell(this.rows[at])));
      }
      this.alive.set(at, made);
      body.append(made);
    }
  }
}
