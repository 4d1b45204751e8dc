// Recorded flights are in the page.
const told = JSON.parse(document.getElementById('flight').textContent);
const player = canDraw() && new Player(told.map((one) => new Flight(one)));
