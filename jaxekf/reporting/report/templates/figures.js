(function () {
  "use strict";
  var root = document.documentElement;
  var plots = Array.prototype.slice.call(document.querySelectorAll(".plot"));
  var config = {
    responsive: true, displaylogo: false, doubleClick: "reset", plotlyServerURL: "", topojsonURL: "",
    showSendToCloud: false,  /* it would offer to send the data away */
    modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d", "sendChartToCloud"]
  };

  /* The 2 sigma band of an estimate, as one closed curve. */
  function band(trace) {
    var about = trace.meta.band === "value" ? trace.y : trace.x.map(function () { return 0; });
    var x = [], upper = [], lower = [];
    trace.x.forEach(function (t, i) {
      if (about[i] === null || trace.customdata[i] === null) { return; }
      x.push(t);
      upper.push(about[i] + trace.customdata[i]);
      lower.push(about[i] - trace.customdata[i]);
    });
    return {
      type: "scatter", mode: "lines", x: x.concat(x.slice().reverse()),
      y: upper.concat(lower.reverse()), xaxis: trace.xaxis, yaxis: trace.yaxis,
      fill: "toself", fillcolor: trace.line.color, opacity: 0.25, line: {width: 0, color: trace.line.color},
      hoverinfo: "skip", showlegend: false
    };
  }

  function read(plot) {
    var script = document.getElementById(plot.id + "-data");
    var figure = JSON.parse(script.textContent);
    var data = [];
    figure.data.forEach(function (trace) {
      if (trace.meta && trace.meta.band !== "none") { data.push(band(trace)); }
      data.push(trace);
    });
    return {data: data, layout: figure.layout};
  }

  /* The time axes of one run move together. */
  var moving = false;
  function follow(plot) {
    plot.on("plotly_relayout", function (change) {
      var touched = Object.keys(change).some(function (key) { return /^xaxis[.]/.test(key); });
      if (moving || !touched) { return; }
      moving = true;
      var range = plot.layout.xaxis.range.slice();
      var others = plots.filter(function (other) {
        return other !== plot && other.dataset.run === plot.dataset.run && other.layout;
      });
      Promise.all(others.map(function (other) {
        return Plotly.relayout(other, {"xaxis.range": range.slice()});
      })).then(function () { moving = false; }, function () { moving = false; });
    });
  }

  /* Domains of the columns of a figure, with a gap for a title between them at any width. */
  function domains(layout, width) {
    var shares = layout.meta.shares, found = {}, begin = 0;
    var gap = 78 / Math.max(width - layout.margin.l - layout.margin.r, 200);
    var total = shares.reduce(function (sum, share) { return sum + share; }, 0);
    shares.forEach(function (share, i) {
      var end = begin + (1 - gap * (shares.length - 1)) * share / total;
      found["xaxis" + (i ? i + 1 : "") + ".domain"] = [begin, Math.min(end, 1)];
      begin = end + gap;
    });
    return found;
  }

  /* A printed page is narrower than a screen, and has room for two figures. */
  function resize(plot, width, scale) {
    if (!plot.layout) { return; }
    var full = plot.layout.meta.height, height = Math.max(Math.round(scale * full), Math.min(full, 250));
    var change = domains(plot.layout, width || plot.clientWidth);
    change.width = width;
    change.height = height;
    change.autosize = !width;
    plot.style.height = height + "px";
    Plotly.relayout(plot, change);
  }
  window.addEventListener("beforeprint", function () {
    plots.forEach(function (plot) { resize(plot, 690, 0.7); });
  });
  window.addEventListener("afterprint", function () {
    plots.forEach(function (plot) { resize(plot, null, 1); });
  });

  /* One after the other, so that the first can be read while the last are drawn. */
  function next(i) {
    if (i === plots.length) { root.setAttribute("data-ready", "true"); return; }
    var figure = read(plots[i]);
    var place = domains(figure.layout, plots[i].clientWidth);
    Object.keys(place).forEach(function (key) { figure.layout[key.split(".")[0]].domain = place[key]; });
    Plotly.newPlot(plots[i], figure.data, figure.layout, config).then(function () {
      follow(plots[i]);
      root.setAttribute("data-drawn", i + 1);
      window.setTimeout(function () { next(i + 1); }, 0);
    });
  }
  next(0);
}());
