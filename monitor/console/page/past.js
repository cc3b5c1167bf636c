// A vehicle's past as columns of numbers, as long as the server keeps it.

const MOST = 4000; // rows; the server keeps 3600
const CUT = 400; // dropped at once, so that most additions move nothing

function numbers(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Float64Array(bytes.buffer);
}

/** Columns under names, with times in seconds; what is not known is null. */
export class Columns {
  constructor(names) {
    this.times = [];
    this.columns = new Map(names.map((name) => [name, []]));
  }

  add(news) {
    const times = numbers(news.times);
    const values = numbers(news.values);
    const columns = [...this.columns.values()];
    const width = values.length / Math.max(times.length, 1);
    for (let k = 0; k < times.length; k++) {
      this.times.push(times[k]);
      columns.forEach((column, c) => {
        const value = values[k * width + c];
        column.push(Number.isFinite(value) ? value : null);
      });
    }
    if (this.times.length > MOST) {
      const drop = this.times.length - MOST + CUT;
      for (const column of [this.times, ...columns]) column.splice(0, drop);
    }
  }

  get(name) {
    return this.columns.get(name);
  }

  last(name) {
    return this.columns.get(name)?.at(-1) ?? null;
  }
}

const ENTRIES = 200;

export class Past {
  constructor() {
    this.observers = new Map(); // name: {faults, outputs, rows: Columns}
    this.status = null;
    this.modes = [];
    this.texts = [];
    this.events = [];
  }

  /** Take news; return whether observers or their channels are others than before. */
  add(news) {
    let changed = false;
    for (const [name, observer] of Object.entries(news.observers ?? {})) {
      if (observer.faults) {
        const { faults, outputs } = observer;
        const kinds = ["isolated", "sd"].flatMap((kind) => faults.map((fault) => `${kind} ${fault}`));
        const names = ["armed", ...kinds, ...outputs.map((output) => `residual ${output}`)];
        this.observers.set(name, { faults, outputs, rows: new Columns(names) });
        changed = true;
      }
      this.observers.get(name)?.rows.add(observer);
    }
    if (news.status) {
      this.status ??= new Columns(news.status.names);
      this.status.add(news.status);
    }
    for (const kind of ["modes", "texts", "events"]) {
      this[kind].push(...(news[kind] ?? []));
      this[kind].splice(0, this[kind].length - ENTRIES);
    }
    return changed;
  }

  /** From when to when each alarm was active, seconds; those that still are end now. */
  get spells() {
    const alarms = new Map();
    for (const event of this.events) {
      const spell = alarms.get(event.id) ?? { id: event.id, start: event.since_s, channel: event.channel };
      spell.end = event.state === "cleared" ? event.time_s : this.end;
      spell.severity = event.severity;
      // what an operator did says nothing of the fault
      if (!spell.message || event.state === "raised" || event.state === "updated") spell.message = event.message;
      alarms.set(event.id, spell);
    }
    return [...alarms.values()];
  }

  /** The oldest time there is, seconds. */
  get begin() {
    const begins = [...this.observers.values()].map((observer) => observer.rows.times[0] ?? Infinity);
    return Math.min(...begins, this.status?.times[0] ?? Infinity);
  }

  /** The newest time there is, seconds. */
  get end() {
    const ends = [...this.observers.values()].map((observer) => observer.rows.times.at(-1) ?? 0);
    return Math.max(...ends, this.status?.times.at(-1) ?? 0);
  }
}
