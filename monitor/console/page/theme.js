// Before anything is drawn: the theme that was chosen here before.
{
  let theme = null;
  try {
    theme = localStorage.getItem("fauio-theme");
  } catch {
    // storage is switched off
  }
  if (theme === "dark" || theme === "light") document.documentElement.dataset.theme = theme;
}
