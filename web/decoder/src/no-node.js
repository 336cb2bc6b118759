// In the place of `node.js` where a bundler makes a page: see `imports` of package.json.
export {};
