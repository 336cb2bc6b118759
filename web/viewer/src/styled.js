export function styled(name, style) {
  const element = document.createElement(name);
  Object.assign(element.style, style);
  return element;
}
