// What is wrong with how the page is laid out now: text that its box cuts off, anything that scrolls by
// itself, a page wider than the screen, STOP outside of it. What is for screen readers only and what
// lies over an image is not meant.
() => {
    const faults = [];
    const name = (e) => `${e.tagName.toLowerCase()}#${e.id}.${e.className} "${e.textContent.slice(0, 40)}"`;
    for (const e of document.querySelectorAll("body *")) {
        if (!e.checkVisibility() || e.closest(".heard, .skip, svg, .view .side, .view .scale")) continue;
        const style = getComputedStyle(e);
        const hasText = [...e.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim());
        if ((hasText || e.matches("button, select, p, li, td, th, label, legend, caption")) && style.display !== "inline" && e.clientWidth) {
            if (e.scrollWidth > e.clientWidth + 1) faults.push(`cut: ${name(e)} ${e.scrollWidth} > ${e.clientWidth}`);
            if (style.overflowY !== "visible" && e.scrollHeight > e.clientHeight + 1) faults.push(`cut below: ${name(e)}`);
        }
        if (/auto|scroll/.test(style.overflowX + style.overflowY)
            && (e.scrollHeight > e.clientHeight + 1 || e.scrollWidth > e.clientWidth + 1)) faults.push(`scrolls: ${name(e)}`);
    }
    const page = document.documentElement;
    if (page.scrollWidth > innerWidth) faults.push(`page is ${page.scrollWidth} wide on ${innerWidth}`);
    const stop = document.getElementById("stop").getBoundingClientRect();
    if (stop.left < 0 || stop.right > innerWidth || stop.top < 0 || stop.bottom > innerHeight) faults.push("STOP is off the screen");
    return faults;
}
