// Alarms of fauio, with nothing but Zenoh: what stands, then what changes.
//
// Needs @eclipse-zenoh/zenoh-ts 1.x, whose sessions go through the remote-api plugin of a router:
//
//     zenohd -c router.json5
//     fauio run --config FILE.toml        # with connect = ["tcp/127.0.0.1:7447"], listen = [], zenoh_mode = "router"
//     npm install && npx tsc -p . && node subscribe.js
//
// A lost WebSocket is not opened again by zenoh-ts 1.10: end and start anew, as a service manager or a reload of the page
// does. The router finds a monitor that was gone by itself; the token below tells.

import { Config, Reply, RingChannel, Sample, SampleKind, Session } from "@eclipse-zenoh/zenoh-ts";

interface Alarm {
  id: string;
  seq: number;
  vehicle: string;
  channel: string;
  state: "raised" | "updated" | "acknowledged" | "shelved" | "cleared";
  severity: "warning" | "critical";
  message: string;
}

const seen = new Set<string>();

function show(alarm: Alarm): void {
  const mark = `${alarm.vehicle} ${alarm.id} ${alarm.seq}`;
  if (seen.has(mark)) return; // it came both ways
  if (seen.size > 10_000) seen.clear();
  seen.add(mark);
  console.log(`${alarm.vehicle}: ${alarm.state} ${alarm.severity} ${alarm.channel}: ${alarm.message}`);
}

async function main(): Promise<void> {
  const session = await Session.open(new Config("ws/127.0.0.1:10000"));

  // First subscribe, then ask: nothing falls between the two.
  await session.declareSubscriber("fauio/*/alarm/**", {
    handler: (sample: Sample) => show(JSON.parse(sample.payload().toString()) as Alarm),
  });

  const tokens = await session.liveliness().declareSubscriber("fauio/*/live", {
    history: true,
    handler: new RingChannel<Sample>(100),
  });
  for await (const token of tokens.receiver()!) {
    const vehicle = token.keyexpr().toString().split("/")[1];
    if (token.kind() === SampleKind.DELETE) {
      console.log(`${vehicle}: monitor is gone`);
      continue;
    }
    const replies = await session.get(`fauio/${vehicle}/alarms`, { handler: new RingChannel<Reply>(10) });
    for await (const reply of replies ?? []) {
      const answer = reply.result();
      if (!(answer instanceof Sample)) continue;
      const standing = JSON.parse(answer.payload().toString()) as Alarm[];
      console.log(`${vehicle}: monitor is there, alarms that stand: ${standing.length}`);
      standing.forEach(show);
    }
  }
}

await main();
