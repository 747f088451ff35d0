"use strict";
// what all pages share: the data, elements, lines over steps
const data = JSON.parse(document.getElementById("data").textContent);

// a new element: tag, attributes, children (texts stay texts)
function make(tag, attributes = {}, ...children) {
  const svg = ["svg", "polyline", "line", "text", "circle"].includes(tag);
  const element = svg
    ? document.createElementNS("http://www.w3.org/2000/svg", tag)
    : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

// numbers that JSON does not have are texts in the data
function words(value, digits = 6) {
  if (value === null || value === undefined) return "";
  const number = Number(value);
  if (!Number.isFinite(number)) return String(value);
  const size = Math.abs(number);
  const plain = number === 0 || (size >= 1e-3 && size < 1e6);
  return plain ? String(Number(number.toPrecision(digits))) : number.toExponential(digits - 2);
}

function copy(text, button) {
  const before = button.textContent;
  const say = (word) => {
    button.textContent = word;
    setTimeout(() => { button.textContent = before; }, 1500);
  };
  const old = () => { // a page opened from a file may have no clipboard
    const area = make("textarea");
    area.value = text;
    document.body.append(area);
    area.select();
    const done = document.execCommand("copy");
    area.remove();
    say(done ? "Copied" : "Not copied");
  };
  if (!navigator.clipboard) { old(); return; }
  navigator.clipboard.writeText(text).then(() => say("Copied"), old);
}

function download(name, text) {
  const address = URL.createObjectURL(new Blob([text], { type: "application/json" }));
  make("a", { href: address, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(address), 1000);
}
