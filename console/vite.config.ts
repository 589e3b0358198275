import { defineConfig } from "vitest/config";

// No code and no style inside the page itself: the console's Content-Security-Policy allows neither.
export default defineConfig({
  base: "./",
  build: {
    assetsInlineLimit: 0,
    modulePreload: { polyfill: false },
    target: "es2022",
  },
  // Property tests take seconds where the machine is busy.
  test: { include: ["src/**/*.test.ts"], testTimeout: 60_000 },
});
