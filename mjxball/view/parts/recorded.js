// Start of a page with recorded flights.
const recorded = JSON.parse(document.getElementById('flight').textContent);
const player = canDraw() && new Player(recorded.map((one) => new Flight(one)));
