// Pages that are opened from disk may not start workers. There, a hidden frame runs the script of the search
// instead, with the interface of a Worker.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      const frame = document.createElement("iframe")
      frame.hidden = true
      document.documentElement.append(frame)
      this.inside = frame.contentWindow
      this.inside.postMessage = data => {
        const event = new MessageEvent("message", { data })
        if (this.onmessage) this.onmessage(event)
        this.dispatchEvent(event)
      }
      this.inside.importScripts = () => {}
      this.loaded = new Promise((done, failed) => {
        const script = frame.contentDocument.createElement("script")
        script.src = url
        script.onload = done
        script.onerror = failed
        frame.contentDocument.head.append(script)
      })
    }
    postMessage(data) {
      this.loaded.then(() => this.inside.dispatchEvent(new MessageEvent("message", { data })))
    }
    terminate() {}
  }
}
