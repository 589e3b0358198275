// Light or dark: as the system says, unless the user chose.
export type Theme = "auto" | "light" | "dark";

const STORED = "fognav.theme";

export function theme(): Theme {
  const stored = localStorage.getItem(STORED);
  return stored === "light" || stored === "dark" ? stored : "auto";
}

export function setTheme(to: Theme): void {
  if (to === "auto") localStorage.removeItem(STORED);
  else localStorage.setItem(STORED, to);
  startTheme();
  dispatchEvent(new Event("themechange"));
}

const system = matchMedia("(prefers-color-scheme: dark)");
system.addEventListener("change", startTheme);

/** Take over the stored choice, or the system's. */
export function startTheme(): void {
  const chosen = theme();
  document.documentElement.dataset.theme = chosen === "auto" ? (system.matches ? "dark" : "light") : chosen;
}

/** Call `listener` when other colours are shown; returns how to stop that. */
export function onTheme(listener: () => void): () => void {
  system.addEventListener("change", listener);
  addEventListener("themechange", listener);
  return () => {
    system.removeEventListener("change", listener);
    removeEventListener("themechange", listener);
  };
}
