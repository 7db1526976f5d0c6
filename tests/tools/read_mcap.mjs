// Reads an MCAP file by the TypeScript library @mcap/core and says what it finds as JSON: an opinion other than the writer's.
// Checked on the way: the index, the CRC of every chunk, that every message decodes by the schema in the file, images, the order of times.
import { open } from "node:fs/promises";
import { McapIndexedReader, McapStreamReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers } from "@mcap/support";
import protobuf from "protobufjs";
import descriptor from "protobufjs/ext/descriptor/index.js";

const path = process.argv[2];
const decompressHandlers = await loadDecompressHandlers();
const handle = await open(path, "r");
const reader = await McapIndexedReader.Initialize({ readable: new FileHandleReadable(handle), decompressHandlers });
const problems = [];
const types = new Map();
for (const schema of reader.schemasById.values()) {
  if (schema.encoding === "protobuf") {
    const root = protobuf.Root.fromDescriptor(descriptor.FileDescriptorSet.decode(schema.data));
    root.resolveAll();
    types.set(schema.id, root.lookupType(schema.name));
  } else if (schema.encoding === "jsonschema") {
    const pending = [JSON.parse(new TextDecoder().decode(schema.data))];
    for (const part of pending) {
      if (part.type === "object" && !part.properties) problems.push(`schema ${schema.name} has an object without properties: no viewer reads it`);
      pending.push(...Object.values(part.properties ?? {}));
    }
  } else {
    problems.push(`schema ${schema.name} has encoding '${schema.encoding}'`);
  }
}
const topics = {};
for (const channel of reader.channelsById.values()) {
  const schema = reader.schemasById.get(channel.schemaId);
  topics[channel.topic] = { schema: schema?.name ?? "", encoding: channel.messageEncoding, messages: 0, last: -1n, formats: [] };
}
const begins = { png: [0x89, 0x50, 0x4e, 0x47], jpeg: [0xff, 0xd8, 0xff] };
for await (const message of reader.readMessages({ validateCrcs: true })) {
  const channel = reader.channelsById.get(message.channelId);
  const topic = topics[channel.topic];
  topic.messages += 1;
  if (message.logTime < topic.last) problems.push(`${channel.topic}: times go back`);
  topic.last = message.logTime;
  if (channel.messageEncoding === "protobuf") {
    const value = types.get(channel.schemaId).decode(message.data);
    if (topic.schema === "foxglove.CompressedImage") {
      const data = Buffer.from(value.data);
      if (!begins[value.format]?.every((byte, i) => data[i] === byte)) problems.push(`${channel.topic}: not a ${value.format}`);
      if (value.format === "jpeg" && !(data[data.length - 2] === 0xff && data[data.length - 1] === 0xd9)) problems.push(`${channel.topic}: cut off`);
      topic.formats.push(value.format);
    }
    if (value.timestamp && BigInt(value.timestamp.seconds) * 1000000000n + BigInt(value.timestamp.nanos) !== message.logTime)
      problems.push(`${channel.topic}: its timestamp is not its time`);
  } else if (channel.messageEncoding === "json") {
    JSON.parse(new TextDecoder().decode(message.data));
  } else {
    problems.push(`${channel.topic}: encoding '${channel.messageEncoding}'`);
  }
}
const stream = new McapStreamReader({ validateCrcs: true, decompressHandlers });
let streamed = 0;
for await (const part of handle.createReadStream({ start: 0, autoClose: false })) {
  stream.append(part);
  for (let record; (record = stream.nextRecord()); ) if (record.type === "Message") streamed += 1;
}
await handle.close();
const counts = Object.fromEntries(Object.entries(topics).map(([name, topic]) => [name, { ...topic, last: topic.last.toString() }]));
const compressions = [...new Set(reader.chunkIndexes.map((chunk) => chunk.compression))];
console.log(JSON.stringify({ chunks: reader.chunkIndexes.length, compressions, statistics: Number(reader.statistics?.messageCount ?? -1), streamed, topics: counts, problems }));
