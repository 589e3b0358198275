// Foxglove's own client of its WebSocket: prints what a server tells, a line of JSON each.
// NODE_PATH=FOLDER/node_modules node foxglove_peer.js ADDRESS TOKEN TOPIC...
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const WebSocket = require("ws");

const [address, token, ...topics] = process.argv.slice(2);
const say = (what) => process.stdout.write(`${JSON.stringify(what)}\n`);
const ws = new WebSocket(address, [FoxgloveClient.SUPPORTED_SUBPROTOCOL], {
  headers: token ? { Authorization: `Bearer ${token}` } : {},
});
ws.on("unexpected-response", (_, answer) => {
  say({ refused: answer.statusCode });
  process.exit(0);
});
const client = new FoxgloveClient({ ws });
const wanted = new Map();
client.on("serverInfo", (info) => {
  say({ name: info.name, capabilities: info.capabilities });
  client.getParameters(["site"], "1");
});
client.on("advertise", (channels) => {
  for (const each of channels.filter((channel) => topics.includes(channel.topic))) {
    wanted.set(client.subscribe(each.id), each);
  }
});
client.on("message", ({ subscriptionId, timestamp, data }) => {
  const { topic, schemaName, schema } = wanted.get(subscriptionId);
  const payload = Buffer.from(data.buffer, data.byteOffset, data.byteLength).toString("base64");
  say({ topic, schemaName, schema, stamp: Number(timestamp) / 1e9, payload });
});
client.on("parameterValues", ({ parameters }) => say({ parameters }));
client.on("close", ({ code, reason }) => say({ closed: code, reason }));
