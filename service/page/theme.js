// Before the first paint: the theme that was chosen here last; dark unless somebody chose light.
try {
  document.documentElement.dataset.theme = localStorage.getItem("theme") || "dark";
} catch {
  // storage is switched off in this browser: the theme is not remembered
}
