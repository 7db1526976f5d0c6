// A browser starts no worker for a page that was opened from a folder. There the script of one, that of the search, runs in a hidden frame instead:
// messages to it are events of the frame's window, and those from it are events of this object.
class WorkerInFrame extends EventTarget {
  constructor(script) {
    super();
    const frame = document.createElement("iframe");
    frame.hidden = true;
    frame.srcdoc = "<!doctype html>";
    this.started = new Promise((resolve) => {
      frame.addEventListener("load", () => {
        const inside = frame.contentWindow;
        inside.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
        const element = inside.document.createElement("script");
        element.src = new URL(script, document.baseURI).href;
        element.addEventListener("load", () => resolve(inside));
        element.addEventListener("error", () => this.dispatchEvent(new Event("error")));
        inside.document.body.append(element);
      }, { once: true });
    });
    document.body.append(frame);
    this.terminate = () => frame.remove();
  }

  postMessage(data) {
    this.started.then((inside) => inside.dispatchEvent(new inside.MessageEvent("message", { data })));
  }
}

if (location.protocol === "file:") window.Worker = WorkerInFrame;
