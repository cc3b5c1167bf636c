// What is new, from the server: one stream while the page is seen, a look now and then while it is not.

const SILENT_MS = 12000; // the server says something every 5 s
const AGAIN_MS = 2000;
const HIDDEN_MS = 10000;

export class Stream {
  /** `on` has functions hello(hello), news(news), lost(bool). */
  constructor(on) {
    this.on = on;
    this.vehicle = null;
    this.source = null;
    this.heardAt = performance.now();
    document.addEventListener("visibilitychange", () => this.open());
    setInterval(() => this.#look(), 1000);
  }

  /** Follow the fleet and one vehicle (null: none). */
  follow(vehicle) {
    this.vehicle = vehicle;
    this.open();
  }

  open() {
    this.source?.close();
    this.source = null;
    this.heardAt = performance.now();
    if (document.hidden) return;
    const query = this.vehicle === null ? "" : `?vehicle=${encodeURIComponent(this.vehicle)}`;
    const source = (this.source = new EventSource(`/stream${query}`));
    const heard = (name, handle) =>
      source.addEventListener(name, (event) => {
        if (source !== this.source) return;
        this.heardAt = performance.now();
        this.on.lost(false);
        handle(JSON.parse(event.data));
        if (document.hidden) this.#hide();
      });
    heard("hello", (hello) => this.on.hello(hello));
    heard("news", (news) => this.on.news(news));
    heard("alive", () => {});
    source.addEventListener("error", () => {
      if (source !== this.source) return;
      this.on.lost(true);
      // a browser does not try again after an answer that was an error
      if (source.readyState === EventSource.CLOSED) setTimeout(() => source === this.source && this.#again(), AGAIN_MS);
    });
  }

  /** Try again, or ask for the token where it is another one now. */
  async #again() {
    const answer = await fetch("/clips").catch(() => null);
    if (answer?.status === 401) location.replace("/login");
    else this.open();
  }

  /** A page that nobody sees gives its connection to others: a browser has six for a host. */
  #hide() {
    this.source?.close();
    this.source = null;
    this.heardAt = performance.now();
  }

  #look() {
    const silent = performance.now() - this.heardAt;
    if (document.hidden) {
      if (silent > HIDDEN_MS && this.source === null) this.#peek();
    } else if (silent > SILENT_MS) {
      this.on.lost(true);
      this.open();
    }
  }

  /** Look once: hello and the first news come at once, and then #hide. */
  #peek() {
    const source = (this.source = new EventSource("/stream"));
    this.heardAt = performance.now();
    source.addEventListener("news", (event) => {
      this.on.news(JSON.parse(event.data));
      if (document.hidden && source === this.source) this.#hide();
    });
    source.addEventListener("error", () => source === this.source && this.#hide());
  }
}
