// Player of a live flight. It follows the newest row until the user seeks back.
class LivePlayer extends Player {
  grow(answer) {
    const there = this.now >= this.last && !this.playing;
    this.panes[0].flight.grow(answer);
    this.fit();
    if (there) this.seek(Infinity); else this.draw();
  }
}

class Live {
  constructor(token) {
    Object.assign(this, { token, rows: 0 });
    this.status = element('p');
    this.status.id = 'status';
    document.getElementById('views').before(this.status);
    this.newest = element('button', 'now');
    this.newest.id = 'newest';
    this.newest.onclick = () => { if (player) { if (player.playing) player.toggle(); player.seek(Infinity); } };
    document.querySelector('.transport').append(this.newest);
    document.getElementById('width').value = '20';
    this.ask();
  }

  setStatus(text, level) {
    this.status.textContent = text;
    this.status.className = level;
  }

  async ask() {
    const begun = performance.now();
    let answer;
    try {
      const found = await fetch(`rows?token=${this.token}&after=${this.rows}`);
      if (found.status === 409) { location.reload(); return; }  // the token is that of an earlier server
      if (!found.ok) throw new Error(found.statusText);
      answer = await found.json();
    } catch {
      this.setStatus('the viewer has ended; what it showed is still here', 'bad');
      setTimeout(() => this.ask(), 1000);
      return;
    }
    this.setStatus(answer.text, answer.level);
    this.take(answer);
    if (answer.ended && this.rows === answer.total) return;
    // A slow browser polls less often: handling answers takes at most a third of its time.
    const spent = performance.now() - begun;
    setTimeout(() => this.ask(), this.rows < answer.total ? 0 : Math.max(100, 2 * spent));
  }

  take(answer) {
    this.rows += answer.rows;
    const news = answer.rows || answer.marks.length !== player?.panes[0].flight.marks.length;
    if (player && news) player.grow(answer);
    else if (answer.rows) { player = new LivePlayer([new Flight(answer)]); player.seek(Infinity); }
  }
}

let player;
const live = canDraw() && new Live(JSON.parse(document.getElementById('flight').textContent).token);
