// What the parts of the page know of the dataset.

export const state = {
  dataset: 0, // its index
  facts: null, // what the server says of it
  scored: [], // of each episode that is ready: curve and figures
  dropped: [], // episodes that `zest curate` would drop, the worst first
};
