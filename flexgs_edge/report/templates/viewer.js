(function () {
  document.documentElement.classList.add('js');
  document.querySelectorAll('.view').forEach(function (view) {
    var stage = view.querySelector('.stage'), range = view.querySelector('input[type=range]');
    function show() {
      stage.style.setProperty('--cut', range.value + '%');
      var right = view.querySelector('input[type=radio]:checked');
      stage.dataset.right = right.value;
      var left = stage.querySelector('.original figcaption').textContent;
      range.setAttribute('aria-valuetext',
        range.value + ' % ' + left + ', the rest ' + right.parentNode.textContent.trim());
    }
    function follow(event) {
      var box = stage.getBoundingClientRect();
      range.value = Math.round(100 * (event.clientX - box.left) / box.width);
      show();
    }
    stage.addEventListener('pointerdown', function (event) {
      stage.setPointerCapture(event.pointerId); follow(event);
    });
    stage.addEventListener('pointermove', function (event) { if (event.buttons) follow(event); });
    view.addEventListener('input', show);
    show();
  });
})();
