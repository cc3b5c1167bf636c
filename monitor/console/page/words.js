// Numbers and times as people say them.

/** Return a number with three digits, without an exponent where one can do without. */
export function figure(value, digits = 3) {
  if (value === null || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size < 1e-9) return "0"; // what rounding leaves
  if (size >= 1e6 || size < 1e-4) return value.toExponential(1);
  return String(Number(value.toPrecision(digits)));
}

export function signed(value) {
  return value >= 1e-9 ? `+${figure(value)}` : figure(value).replace("-", "−");
}

/** Return a time that has passed, as `fauio alarms` says it. */
export function age(seconds) {
  const s = Math.max(0, Math.floor(seconds));
  if (s < 60) return `${s} s`;
  if (s < 3600) return `${Math.floor(s / 60)} min`;
  if (s < 86400) return `${Math.floor(s / 3600)} h ${Math.floor(s / 60) % 60} min`;
  return `${Math.floor(s / 86400)} d`;
}

export function timeOfDay(seconds) {
  const date = new Date(seconds * 1000);
  return Number.isNaN(date.getTime()) ? "?" : date.toISOString().slice(11, 19) + "Z";
}

export function dateAndTime(seconds) {
  const date = new Date(seconds * 1000);
  return Number.isNaN(date.getTime()) ? "?" : date.toISOString().slice(0, 19).replace("T", " ") + "Z";
}

/** Words of the status for why an observer has no evidence. */
export function whyNot(word) {
  const [first, ...rest] = word.split(" ");
  const known = {
    on_ground: "on the ground",
    gap: "telemetry has a gap",
    settling: "settling",
    not_carried: "what it watches does not carry the vehicle alone",
    clock: "the vehicle's clock jumps",
    contradicted: "telemetry contradicts itself",
    outside_envelope: "outside of what was learned",
    starved: "too little telemetry",
    no_message: `no ${rest.join(" ")}`,
  };
  return known[first] ?? word;
}
