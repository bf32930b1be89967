// Sphinx highlights the words of a search within others too, such as "long" in "belongs": this keeps whole words alone.
new MutationObserver(() => {
  for (const span of document.querySelectorAll("span.highlighted")) {
    const [before, after] = [span.previousSibling, span.nextSibling].map((node) => node?.nodeValue ?? "");
    if (/[\p{L}\p{N}_]$/u.test(before) || /^[\p{L}\p{N}_]/u.test(after)) span.classList.remove("highlighted");
  }
}).observe(document, { childList: true, subtree: true });
