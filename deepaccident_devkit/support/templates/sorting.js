'use strict';
// A click on the heading of a column sorts the table's rows by it; another one turns the order round.
// The key of a cell is its data-key, a number or empty for unknown, or else its text; unknown ones are always last.
function keyOf(row, column) {
  const cell = row.cells[column];
  if (cell.dataset.key === undefined) return cell.textContent.trim();
  return cell.dataset.key === '' ? null : Number(cell.dataset.key);
}

function compared(one, other) {
  return typeof one === 'number' ? one - other : one.localeCompare(other, 'en', { numeric: true });
}

function sort(table, headings, column) {
  const turn = headings[column].getAttribute('aria-sort') === 'ascending' ? -1 : 1;
  headings.forEach((each) => each.removeAttribute('aria-sort'));
  headings[column].setAttribute('aria-sort', turn === 1 ? 'ascending' : 'descending');
  const keyed = [...table.tBodies[0].rows].map((row) => [keyOf(row, column), row]);
  const known = keyed.filter(([key]) => key !== null).sort(([one], [other]) => turn * compared(one, other));
  const unknown = keyed.filter(([key]) => key === null);
  table.tBodies[0].append(...[...known, ...unknown].map(([, row]) => row));
}

for (const table of document.querySelectorAll('table.sortable')) {
  const headings = [...table.tHead.rows[table.tHead.rows.length - 1].cells];
  headings.forEach((heading, column) => {
    const button = document.createElement('button');
    button.type = 'button';
    button.append(...heading.childNodes);
    heading.append(button);
    button.addEventListener('click', () => sort(table, headings, column));
  });
}
