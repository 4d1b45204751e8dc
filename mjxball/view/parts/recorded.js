// A recorded flight is in the page.
const player = new Player(new Flight(JSON.parse(document.getElementById('flight').textContent)));
