// Search runs in a worker, which browsers refuse to pages that were opened from a folder. There, a
// hidden frame takes the worker's place: it runs the same script, and messages pass as usual.
if (location.protocol === "file:") {
  window.Worker = window.IFrameWorker = class extends EventTarget {
    constructor(url) {
      super();
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      document.body.append(this.frame);
      const inner = this.frame.contentWindow;
      inner.postMessage = (data) => {
        const event = new MessageEvent("message", { data });
        this.dispatchEvent(event);
        if (this.onmessage) this.onmessage(event);
      };
      const script = inner.document.createElement("script");
      const loaded = new Promise((resolve) => (script.onload = resolve));
      this.postMessage = (data) =>
        loaded.then(() => inner.dispatchEvent(new inner.MessageEvent("message", { data })));
      script.src = url;
      inner.document.body.append(script);
    }

    terminate() {
      this.frame.remove();
    }
  };
}
