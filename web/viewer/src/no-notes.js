/** For pages that were made without notes. */
export async function notesOf(source) {
  if (source) throw new Error('This page was made without notes: flexgs-edge view --notes.');
  return [];
}

export const showNotes = () => () => {};
