/* Mend what hinders readers who use a keyboard or a screen reader. */
document.addEventListener("DOMContentLoaded", () => {
  // Wide tables scroll; a keyboard scrolls them once they can have the focus.
  const wide = () => {
    for (const table of document.querySelectorAll(".bd-article table, .bd-article .sig")) {
      if (table.scrollWidth > table.clientWidth) table.tabIndex = 0;
      else table.removeAttribute("tabindex");
    }
  };
  wide();
  addEventListener("load", wide);
  addEventListener("resize", wide);
  for (const details of document.querySelectorAll("details")) {
    details.addEventListener("toggle", wide);
  }
  // docutils gives lists of citations a role that their entries do not have.
  for (const list of document.querySelectorAll(".citation-list[role=list]")) {
    list.removeAttribute("role");
  }
  // The gallery hides the text of its links.
  for (const link of document.querySelectorAll(".sphx-glr-thumbcontainer a.internal")) {
    link.setAttribute("aria-label", link.textContent.trim());
  }
});
