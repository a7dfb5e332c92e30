// Newest values of a spacecraft, as `GET parameters` lists them, with those of a message of the feed.
export function merged(parameters, { packet, time, age_s, values }) {
  const given = new Map(values.map((one) => [one.name, one]));
  return parameters.map((one) => (one.packet === packet ? { ...one, ...given.get(one.name), time, age_s, received: Date.now() } : one));
}
