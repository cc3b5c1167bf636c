// The table of alarms, and what operators do to them.
import { el, remembered, say, sync } from "./dom.js";
import { age, timeOfDay } from "./words.js";

const keyOf = (alarm) => `${alarm.vehicle}/${alarm.observer}/${alarm.channel}`;

export class AlarmTable {
  /** `of` is the vehicle (null: all), `app` has hello, now() and tell(text). */
  constructor(app, of) {
    this.app = app;
    this.of = of;
    this.rows = el("tbody");
    const titles = ["Severity", ...(of === null ? ["Vehicle"] : []), "Channel", "Size", "Since", "State", "What", ""];
    const head = el("thead", {}, el("tr", {}, ...titles.map((title) => el("th", { scope: "col" }, title))));
    this.table = el("table", { class: "alarms", hidden: true }, head, this.rows);
    this.none = el("p", { class: "quiet" });
    this.more = el("p", { class: "quiet" });
    this.element = el("div", { class: "wide" }, this.table, this.none, this.more);
  }

  update(alarms, more) {
    const shown = this.of === null ? alarms : alarms.filter((alarm) => alarm.vehicle === this.of);
    this.table.hidden = shown.length === 0;
    say(this.none, shown.length ? "" : "No alarm is active.");
    say(this.more, more ? `and ${more} more` : "");
    sync(this.rows, shown, keyOf, (alarm) => this.#make(alarm), (row, alarm) => this.#fill(row, alarm));
  }

  /** Bring the ages up to date. */
  tick() {
    for (const row of this.rows.children) {
      say(row.at.since, age((this.app.now() - row.alarm.since_ns) / 1e9));
    }
  }

  #make(alarm) {
    const at = {};
    const cell = (name, title, child) => (at[name] = el("td", { "data-title": title, class: name }, child ?? ""));
    const row = el("tr", { tabindex: "0", keydown: (event) => this.#key(event, row) }, cell("severity", "Severity"));
    if (this.of === null) {
      const link = el("a", { href: `#/vehicle/${encodeURIComponent(alarm.vehicle)}` }, alarm.vehicle);
      row.append(cell("vehicle", "Vehicle", link));
    }
    row.append(cell("channel", "Channel"), cell("size", "Size"), cell("since", "Since"), cell("state", "State"));
    row.append(cell("what", "What"), cell("actions", ""));
    at.badge = el("span", { class: "badge" });
    at.severity.append(at.badge);
    row.at = at;
    return row;
  }

  #fill(row, alarm) {
    const at = row.at;
    row.alarm = alarm;
    row.dataset.group = alarm.group;
    row.dataset.severity = alarm.severity;
    row.dataset.acknowledged = alarm.acknowledged;
    at.badge.className = alarm.group === "active" ? `badge ${alarm.severity}` : "badge";
    say(at.badge, alarm.group === "cleared" ? "cleared" : alarm.severity);
    say(at.channel, `${alarm.observer}/${alarm.channel}`);
    say(at.size, alarm.display ?? "");
    say(at.since, age((this.app.now() - alarm.since_ns) / 1e9));
    say(at.state, stateOf(alarm));
    say(at.what, alarm.message);
    const verbs = this.#verbs(alarm).join(" ");
    if (row.verbs === verbs) return;
    const focused = at.actions.contains(document.activeElement);
    row.verbs = verbs;
    at.actions.replaceChildren(
      ...this.#verbs(alarm).map((verb) =>
        el("button", { type: "button", click: () => this.#do(verb, row.alarm) }, WORDS[verb]),
      ),
    );
    if (focused) row.focus();
  }

  #verbs(alarm) {
    if (!this.app.hello.commands || alarm.group === "cleared") return [];
    const shelve = alarm.group === "shelved" ? "unshelve" : "shelve";
    return [...(alarm.acknowledged ? [] : ["ack"]), shelve, "reset"];
  }

  #key(event, row) {
    const rows = [...this.rows.children];
    const next = { ArrowDown: 1, j: 1, ArrowUp: -1, k: -1 }[event.key];
    const verb = { a: "ack", s: row.alarm.group === "shelved" ? "unshelve" : "shelve", c: "reset" }[event.key];
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (next) rows[rows.indexOf(row) + next]?.focus();
    else if (verb && this.#verbs(row.alarm).includes(verb)) this.#do(verb, row.alarm);
    else if (event.key === "Enter" && event.target === row) {
      location.hash = `#/vehicle/${encodeURIComponent(row.alarm.vehicle)}`;
    } else return;
    event.preventDefault();
    event.stopPropagation();
  }

  async #do(verb, alarm) {
    const details = verb === "ack" || verb === "unshelve" ? {} : await ask(verb, alarm);
    if (details === null) return;
    const body = { vehicle: alarm.vehicle, verb, id: alarm.id, by: remembered("name") || "console", ...details };
    try {
      const headers = { "Content-Type": "application/json" };
      const answer = await fetch("/command", { method: "POST", headers, body: JSON.stringify(body) });
      const said = await answer.json();
      this.app.tell(answer.ok ? `${WORDS[verb]}: ${alarm.channel} of ${alarm.vehicle}, done` : said.error, answer.ok);
    } catch {
      this.app.tell("The console does not answer: nothing was done.", false);
    }
  }
}

const WORDS = { ack: "Acknowledge", shelve: "Shelve", unshelve: "Unshelve", reset: "Close" };

function stateOf(alarm) {
  if (alarm.group === "cleared") return "cleared";
  const parts = [];
  if (alarm.acknowledged) parts.push("acknowledged");
  if (alarm.latched) parts.push("latched");
  if (alarm.recurring) parts.push("recurring");
  if (alarm.group === "shelved") parts.push(`shelved until ${timeOfDay(alarm.shelved_until_ns / 1e9).slice(0, 5)}Z`);
  return parts.join(", ") || "raised";
}

/** Ask why, and for how long; return null where the operator thinks better of it. */
function ask(verb, alarm) {
  const dialog = document.getElementById("dialog");
  const minutes = el("input", { type: "number", min: "1", max: "480", value: "60", id: "minutes", required: true });
  const reason = el("input", { type: "text", id: "reason", maxlength: "200" });
  const explain = {
    shelve: "It stays silent for this time, then it is raised again if its cause is still there.",
    reset: "The alarm ends and its observer begins anew; it is raised again if its cause is still there.",
  }[verb];
  return new Promise((resolve) => {
    const done = (value) => {
      dialog.close();
      resolve(value);
    };
    const form = el(
      "form",
      {
        submit: (event) => {
          event.preventDefault();
          const why = reason.value ? { reason: reason.value } : {};
          done(verb === "shelve" ? { minutes: Number(minutes.value), ...why } : why);
        },
      },
      el("h2", {}, `${WORDS[verb]} ${alarm.channel} of ${alarm.vehicle}`),
      el("p", {}, explain),
      ...(verb === "shelve" ? [el("label", { for: "minutes" }, "Minutes"), minutes] : []),
      el("label", { for: "reason" }, "Reason, for the journal"),
      reason,
      el(
        "p",
        { class: "buttons" },
        el("button", { type: "submit", class: "primary" }, WORDS[verb]),
        el("button", { type: "button", click: () => done(null) }, "Cancel"),
      ),
    );
    dialog.replaceChildren(form);
    dialog.addEventListener("cancel", () => resolve(null), { once: true });
    dialog.showModal();
  });
}
