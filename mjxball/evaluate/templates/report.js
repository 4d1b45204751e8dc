const table = document.getElementById('table'), body = table.tBodies[0];
const scenario = document.getElementById('scenario'), follower = document.getElementById('follower');
function show() {
  for (const row of body.rows)
    row.hidden = (scenario.value && row.cells[0].textContent !== scenario.value)
      || (follower.value && row.cells[1].textContent !== follower.value);
}
scenario.onchange = follower.onchange = show;
table.tHead.onclick = (event) => {
  const cell = event.target.closest('th');
  if (!cell) return;
  const up = cell.getAttribute('aria-sort') !== 'ascending', column = cell.cellIndex;
  for (const other of table.tHead.rows[0].cells) other.removeAttribute('aria-sort');
  cell.setAttribute('aria-sort', up ? 'ascending' : 'descending');
  const key = (row) => {
    const c = row.cells[column];
    return c.dataset.v === undefined ? c.textContent : +c.dataset.v;
  };
  const rows = [...body.rows].sort((a, b) => {
    const x = key(a), y = key(b);
    return (x < y ? -1 : x > y ? 1 : 0) * (up ? 1 : -1);
  });
  body.append(...rows);
};
