import { defineConfig } from "vitest/config";

// No code and no style inside the page itself: the console's Content-Security-Policy allows neither.
export default defineConfig({
  base: "./",
  build: {
    assetsInlineLimit: 0,
    modulePreload: { polyfill: false },
    target: "es2022",
  },
  test: { include: ["src/**/*.test.ts"] },
});
