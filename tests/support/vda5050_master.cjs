// A master control by npm's `vda-5050-lib`, whose folder NODE_PATH names, against one robot: validates all it hears by
// that library's own schemas, sends it along an order, and prints what the library says of it, a line of JSON each.
//
//     node vda5050_master.cjs '{"url": "mqtts://127.0.0.1:8883", "username": "u", "password": "p", "ca": "PEM",
//                               "agv": {"manufacturer": "fognav", "serialNumber": "r1"}, "order": {...}, "version": "2.0.0"}'
const { MasterController, Topic } = require("vda-5050-lib");

const given = JSON.parse(process.argv[2]);
const say = (what, more = {}) => console.log(JSON.stringify({ what, ...more }));

async function main() {
  const master = new MasterController(
    {
      interfaceName: "vda5050",
      vdaVersion: given.version,
      topicObjectValidation: { inbound: true, outbound: true },
      transport: {
        brokerUrl: given.url,
        protocolVersion: "3.1.1",
        tlsOptions: given.ca ? { ca: given.ca } : undefined,
        username: given.username,
        password: given.password,
      },
    },
    { targets: given.agv },
  );
  await master.start();
  const isOld = given.version === "1.1.0"; // without a factsheet
  if (!isOld) await master.subscribe(Topic.Factsheet, given.agv, (found) => say("factsheet", { version: found.version }));
  await master.subscribe(Topic.Visualization, given.agv, () => say("visualization"));
  master.trackAgvs((agv, state) => say("connection", { state }));
  await master.initiateInstantActions(
    given.agv,
    { instantActions: [{ actionType: isOld ? "stateRequest" : "factsheetRequest", actionId: "f1", blockingType: "NONE" }] },
    {
      onActionStateChanged: (state) => say("action", { status: state.actionStatus }),
      onActionError: (error) => say("action", { error: error.errorType }),
    },
  );
  await master.assignOrder(given.agv, given.order, {
    onNodeTraversed: (node) => say("traversed", { node: node.nodeId }),
    onEdgeTraversing: (edge, _start, _end, changes) => say("edge", { edge: edge.edgeId, driving: changes.driving }),
    onOrderProcessed: (error, cancelled, active) => {
      say("processed", { error: error ? error.errorType : null, cancelled, active });
      if (!active) {
        setTimeout(() => master.stop().then(() => process.exit(0)), 500);
      }
    },
  });
}

main().catch((error) => {
  say("failed", { error: String(error) });
  process.exit(1);
});
