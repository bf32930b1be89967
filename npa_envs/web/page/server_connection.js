// The engine of the viewer: the server of npa_envs/web/server.py, over a WebSocket.

import { start } from "./page.js";
import { TrainingCard, addressOf } from "./training.js";

const HEADER = 5; // 32-bit numbers before a frame's positions

// Connects to the server that the page came from; it has no settings.
async function connect(settings, listener) {
  const address = addressOf("socket");
  address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
  const socket = new WebSocket(address);
  socket.binaryType = "arraybuffer";
  const send = (message) => {
    if (socket.readyState !== WebSocket.OPEN) return;
    socket.send(message instanceof Blob ? message : JSON.stringify(message));
  };
  const card = new TrainingCard(send);
  socket.onmessage = ({ data }) => {
    const event = typeof data === "string" ? JSON.parse(data) : frameOf(data);
    card.listen(event);
    listener(event);
  };
  await new Promise((opened, failed) => {
    socket.onopen = opened;
    socket.onclose = () => failed(Error("the server does not answer: is it still running?"));
  });
  socket.onclose = ({ reason }) => listener({
    type: "error", message: reason || "the connection is closed: start npa-envs view again",
  });
  return { send };
}

// Frames: step, count, dimension (uint32), milliseconds, loss (float32; NaN: not computed),
// positions (float32), colours (uint8); all little-endian, as browsers' arrays are.
function frameOf(data) {
  const [step, count, dimension] = new Uint32Array(data, 0, 3);
  const [milliseconds, loss] = new Float32Array(data, 12, 2);
  const positions = new Float32Array(data, 4 * HEADER, count * dimension);
  const colours = new Uint8Array(data, 4 * (HEADER + count * dimension), 3 * count);
  const frame = { type: "frame", step, positions, colours, milliseconds };
  return Number.isFinite(loss) ? { ...frame, loss } : frame;
}

start(connect, {});
