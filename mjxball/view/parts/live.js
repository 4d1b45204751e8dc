// A flight that is being flown: asks the server for new rows, and stays at the newest until somebody looks back.
class LivePlayer extends Player {
  grow(answer) {
    const { flight } = this, there = this.row === flight.rows - 1 && !this.playing;
    flight.grow(answer);
    this.recipes().forEach(({ series }, k) => this.plots[k].grow(flight.time, series));
    this.scene.fit();
    this.seeker.max = flight.rows - 1;
    if (there) this.seek(Infinity); else this.draw();
  }
}

class Live {
  constructor(token) {
    Object.assign(this, { token, rows: 0 });
    this.status = document.createElement('p');
    this.status.id = 'status';
    document.querySelector('.view').before(this.status);
    this.newest = document.createElement('button');
    this.newest.id = 'newest';
    this.newest.textContent = 'now';
    this.newest.onclick = () => { if (player) { if (player.playing) player.toggle(); player.seek(Infinity); } };
    document.querySelector('.transport').append(this.newest);
    document.getElementById('now-cg').parentElement.hidden = true;
    document.getElementById('width').value = '20';
    this.ask();
  }

  tell(text, level) {
    this.status.textContent = text;
    this.status.className = level;
  }

  async ask() {
    const begun = performance.now();
    let answer;
    try {
      const found = await fetch(`rows?token=${this.token}&after=${this.rows}`);
      if (found.status === 409) { location.reload(); return; }  // another viewer, another flight
      if (!found.ok) throw new Error(found.statusText);
      answer = await found.json();
    } catch {
      this.tell('the viewer has ended; what it showed is still here', 'bad');
      setTimeout(() => this.ask(), 1000);
      return;
    }
    this.tell(answer.text, answer.level);
    if (answer.rows) this.take(answer);
    if (answer.ended && this.rows === answer.total) return;
    // A slow browser asks less often: most of its time is its own.
    const spent = performance.now() - begun;
    setTimeout(() => this.ask(), this.rows < answer.total ? 0 : Math.max(100, 2 * spent));
  }

  take(answer) {
    this.rows += answer.rows;
    if (player) player.grow(answer);
    else { player = new LivePlayer(new Flight(answer)); player.seek(Infinity); }
  }
}

let player;
const live = new Live(JSON.parse(document.getElementById('flight').textContent).token);
