// Where scans come from: the local server, or elements of this very file. Both give the same bytes.

const KEPT = 6; // scans that stay decoded, so that going back and forth is instant

class Source {
  constructor(settings) {
    this.entries = settings.entries || null;
    this.names = settings.names || this.entries.map((entry) => entry.name);
    this.count = this.entries ? this.entries.length : settings.count; // null: only reading tells
    this.both = settings.captions;
    this.kept = new Map();
  }

  captions(number) { return this.entries ? this.entries[number].captions : this.both; }
  name(number) { return this.names[number] || String(number).padStart(6, "0"); }

  // How far the slider may go as far as is known.
  reach(number) { return this.count === null ? Math.max(this.names.length, number + 2) : this.count; }

  async load(number, version) {
    const key = `${number}/${version}`;
    if (!this.kept.has(key)) this.kept.set(key, this.read(number, version));
    const scan = this.kept.get(key);
    this.kept.delete(key);
    this.kept.set(key, scan); // the last used is the last to go
    while (this.kept.size > 2 * KEPT) this.kept.delete(this.kept.keys().next().value);
    try {
      return await scan;
    } catch (error) {
      this.kept.delete(key);
      throw error;
    }
  }

  async read(number, version) {
    const scan = decode(await (this.entries ? this.inside(number, version) : this.served(number, version)));
    if (scan.name && version === 0) this.names[number] = scan.name; // of a message, which only reading tells
    return scan;
  }

  async inside(number, version) {
    if (!globalThis.DecompressionStream) throw new Error("expected a browser of 2023 or later, found one that cannot unpack the scans of this page");
    const text = document.getElementById(`scan-${number}-${version}`).textContent;
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
  }

  async served(number, version) {
    const response = await fetch(`scan/${number}/${version}`).catch(() => {
      throw new Error("expected an answer of lidarsynth view, found none: was it ended? Start it again, and open the address that it prints");
    });
    if (response.status === 204) { // behind the last, of those that are counted as they are read
      this.count = number;
      throw new End();
    }
    if (response.headers.get("Content-Type") !== "application/octet-stream") throw new Error(await response.text());
    return response.arrayBuffer();
  }
}

class End extends Error {}
