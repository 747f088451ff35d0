// a search tree whose nodes open; what is closed has no elements yet
const children = data.parent.map(() => []);
data.parent.forEach((parent, node) => { if (parent >= 0) children[parent].push(node); });
children.forEach((found) => found.sort((a, b) => data.visits[b] - data.visits[a] || a - b));
const best = new Set(data.path), rows = new Map();

// the numbers of the action that leads to a node
function action(node) {
  if (!node) return "";
  const chosen = data.parent[node] === 0 && data.start.length ? data.start : data.x;
  return chosen.map((group) => group.columns.map((column, j) =>
    `${group.name}${group.entries[j]} = ${words(column[node], 4)}`).join(", ")
    + (group.more ? `, ${group.more} more` : "")).join(", ");
}

function row(node) {
  const leaf = !children[node].length;
  const most = node ? data.visits[children[data.parent[node]][0]] : data.visits[0];
  const bar = make("i", { style: `width:${100 * data.visits[node] / Math.max(most, 1)}%` });
  const button = make("button", { class: best.has(node) ? "node best" : "node" },
    make("span", { class: "mark" }, leaf ? "" : "▸"), make("span", { class: "bar" }, bar),
    make("span", { class: "visits" }, `N ${data.visits[node]}`),
    make("span", { class: "q" }, `Q ${words(data.q[node], 4)}`),
    make("span", { class: "best-below" }, `best ${words(data.best[node], 5)}`));
  if (data.failing[node]) button.append(make("span", { class: "end" }, `${data.failing[node]} fail`));
  if (data.end[node]) {
    button.append(make("span", { class: "end" }, `end, distance ${words(data.distance[node], 4)}`));
  }
  button.append(make("span", { class: "action" }, node ? action(node) : "root"));
  const item = make("li", {}, button);
  rows.set(node, { item, button, leaf });
  if (!leaf) button.setAttribute("aria-expanded", "false");
  button.addEventListener("click", () => (isOpen(node) ? close(node) : open(node)));
  return item;
}

function isOpen(node) {
  return rows.get(node).button.getAttribute("aria-expanded") === "true";
}

function open(node) {
  const { item, button, leaf } = rows.get(node);
  if (leaf || isOpen(node)) return;
  const list = make("ul", { class: "tree" }, ...children[node].map(row));
  if (data.more[node]) {
    list.append(make("li", { class: "note" },
      `${data.more[node]} more children, visited less, are not in this page`));
  }
  item.append(list);
  button.setAttribute("aria-expanded", "true");
  button.querySelector(".mark").textContent = "▾";
}

function close(node) {
  const { item, button } = rows.get(node);
  if (item.querySelector("ul")) item.querySelector("ul").remove();
  button.setAttribute("aria-expanded", "false");
  button.querySelector(".mark").textContent = "▸";
}

document.getElementById("tree").append(make("ul", { class: "tree" }, row(0)));
const along = () => data.path.forEach((node) => { if (!isOpen(node)) open(node); });
document.getElementById("best").addEventListener("click", along);
document.getElementById("close").addEventListener("click", () => close(0));
along();
