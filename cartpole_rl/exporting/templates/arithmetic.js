function clamped(value, low, high) {
  return Math.min(Math.max(value, low), high);
}
function copysign(value, sign) {
  const negative = sign < 0 || Object.is(sign, -0);
  return negative ? -Math.abs(value) : Math.abs(value);
}
function finite(value, ofNan, ofInfinity, ofMinusInfinity) {
  if (Number.isFinite(value)) return value;
  return Number.isNaN(value) ? ofNan : value > 0 ? ofInfinity : ofMinusInfinity;
}
function remainder(value, by) {
  const rest = value % by;
  return rest !== 0 && rest < 0 !== by < 0 ? rest + by : rest;
}
function rounded(value) {
  const below = Math.floor(value), rest = value - below;
  return rest < 0.5 || (rest === 0.5 && below % 2 === 0) ? below : below + 1;
}
function sign(value) {
  return (value > 0) - (value < 0);
}
