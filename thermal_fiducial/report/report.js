'use strict';
// Draws the figures in the colours of the page, lets those over time share their axis, and marks where one reads.
(() => {
  const dark = window.matchMedia('(prefers-color-scheme: dark)');
  // Where nothing can hover, Plotly shows its buttons all the time.
  const touch = window.matchMedia('(pointer: coarse), (hover: none)');
  const narrow = window.matchMedia('(max-width: 760px)');
  const timed = [];
  const drawn = [];

  const colours = () => {
    const style = getComputedStyle(document.documentElement);
    const value = (name) => style.getPropertyValue(name).trim();
    return { ink: value('--ink'), faint: value('--faint'), line: value('--line'), card: value('--card') };
  };

  // What follows the colour scheme, as keys of Plotly.relayout.
  const scheme = (layout) => {
    const { ink, faint, line, card } = colours();
    const change = {
      paper_bgcolor: 'rgba(0,0,0,0)', plot_bgcolor: 'rgba(0,0,0,0)', 'font.color': ink,
      'legend.bgcolor': 'rgba(0,0,0,0)', 'legend.font.color': faint,
      'hoverlabel.bgcolor': card, 'hoverlabel.font.color': ink, 'hoverlabel.bordercolor': line,
      'modebar.color': faint, 'modebar.activecolor': ink, 'modebar.bgcolor': 'rgba(0,0,0,0)',
    };
    const axes = Object.keys(layout).filter((key) => /^[xy]axis\d*$/.test(key));
    if (layout.scene) axes.push('scene.xaxis', 'scene.yaxis', 'scene.zaxis');
    for (const axis of axes) {
      Object.assign(change, { [`${axis}.gridcolor`]: line, [`${axis}.zerolinecolor`]: line,
        [`${axis}.linecolor`]: line, [`${axis}.tickfont.color`]: faint, [`${axis}.title.font.color`]: faint });
      if (axis.startsWith('scene')) change[`${axis}.backgroundcolor`] = card;
    }
    return change;
  };

  // The end of a range that a change of any horizontal axis brings; undefined where it brings none.
  const end = (event, index) => Object.entries(event)
    .find(([key]) => new RegExp(`^xaxis\\d*\\.range\\[${index}\\]$`).test(key))?.[1];
  const show = (plot, range) => {
    const now = plot.layout.xaxis.range;
    if (now && now[0] === range[0] && now[1] === range[1]) return Promise.resolve();
    const axes = Object.keys(plot.layout).filter((key) => /^xaxis\d*$/.test(key));
    return Plotly.relayout(plot, Object.fromEntries(axes.map((axis) => [`${axis}.range`, [...range]])));
  };
  const share = (event) => {
    const all = Object.keys(event).some((key) => /^xaxis\d*\.autorange$/.test(key));
    const range = all ? whole : [end(event, 0), end(event, 1)];
    if (range.every((value) => value !== undefined)) timed.forEach((plot) => show(plot, range));
  };

  let whole = [0, 1];
  const draw = async (script) => {
    const plot = document.getElementById(script.dataset.chart);
    const figure = JSON.parse(script.textContent);
    const layout = figure.layout;
    layout.autosize = true;
    layout.font = { family: 'system-ui, sans-serif', size: 12 };
    // A finger scrolls the page; the buttons above a plot zoom it.
    if (touch.matches && !layout.scene) layout.dragmode = false;
    if (narrow.matches) layout.margin = { ...layout.margin, r: 6 };
    if (narrow.matches && layout.scene) {
      // From farther away the whole path fits into an upright picture.
      const { eye, center } = layout.scene.camera;
      layout.scene.camera = { eye: { x: 1.7 * eye.x, y: 1.7 * eye.y, z: 1.7 * eye.z }, center };
      layout.legend = { orientation: 'h', x: 0, y: 0, yanchor: 'top' };
      layout.margin.b = 110;
      layout.height = 540;
    } else if (!layout.scene && (narrow.matches || touch.matches)) {
      // The buttons are always there, above the plot; what the lines mean stands below it.
      layout.legend = { ...layout.legend, yref: 'container', y: 0, yanchor: 'bottom' };
      // Entries are 29 px high; on a phone hardly two of them stand side by side.
      const names = new Set(figure.data.map((trace) => trace.name)).size;
      const below = 29 * Math.ceil(names / (narrow.matches ? 1 : 4));
      layout.margin.b += below;
      layout.height += below;
    }
    const config = { responsive: true, displaylogo: false, displayModeBar: touch.matches ? true : 'hover',
      modeBarButtonsToRemove: ['select2d', 'lasso2d', 'autoScale2d', 'sendChartToCloud', 'sendDataToCloud'], scrollZoom: Boolean(layout.scene) };
    await Plotly.newPlot(plot, figure.data, layout, config);
    await Plotly.relayout(plot, scheme(plot.layout));
    drawn.push(plot);
    if (script.dataset.timed === 'yes') {
      timed.push(plot);
      plot.on('plotly_relayout', share);
    }
  };

  const start = async () => {
    for (const script of document.querySelectorAll('script.figure')) await draw(script);
    const ranges = timed.map((plot) => plot.layout.xaxis.range).filter(Boolean);
    if (ranges.length) {
      whole = [Math.min(...ranges.map((r) => r[0])), Math.max(...ranges.map((r) => r[1]))];
      for (const plot of timed) await show(plot, whole);
    }
    document.body.dataset.drawn = String(drawn.length);
  };

  dark.addEventListener('change', () => drawn.forEach((plot) => Plotly.relayout(plot, scheme(plot.layout))));
  const links = new Map([...document.querySelectorAll('nav a')].map((link) => [link.hash.slice(1), link]));
  const parts = [...links.keys()].map((id) => document.getElementById(id)).filter(Boolean);
  // The part in whose beginning, or behind it, the upper third of the window ends; in a tall one 300 px count as that.
  const mark = () => {
    const line = Math.min(0.3 * window.innerHeight, 300);
    const begun = parts.filter((part) => part.getBoundingClientRect().top <= line);
    const atEnd = window.scrollY > 0 && window.scrollY + window.innerHeight >= document.documentElement.scrollHeight - 2;
    const here = atEnd ? parts.at(-1) : begun.at(-1) ?? parts[0];
    links.forEach((link, id) => link.classList.toggle('here', id === here?.id));
  };
  window.addEventListener('scroll', mark, { passive: true });
  window.addEventListener('resize', mark);
  mark();
  start();
})();
