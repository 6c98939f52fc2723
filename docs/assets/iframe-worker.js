// Search in pages that are opened from the disk, where browsers start no workers: the search then
// runs in a hidden frame. (MkDocs Material would fetch such a script from elsewhere.)
class FrameWorker extends EventTarget {
  constructor(url) {
    super();
    this.frame = document.createElement("iframe");
    this.frame.hidden = true;
    document.body.appendChild(this.frame);
    this.inside = this.frame.contentWindow;
    this.inside.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
    this.loaded = this.load(url);
    this.inside.importScripts = (...urls) =>
      urls.reduce((former, next) => former.then(() => this.load(next)), Promise.resolve());
  }

  load(url) {
    const script = this.inside.document.createElement("script");
    script.src = url;
    const done = new Promise((resolve) => (script.onload = resolve));
    this.inside.document.body.appendChild(script);
    return done;
  }

  postMessage(data) {
    this.loaded.then(() => this.inside.dispatchEvent(new MessageEvent("message", { data })));
  }

  terminate() {
    this.frame.remove();
  }
}

if (location.protocol === "file:") window.Worker = FrameWorker;
