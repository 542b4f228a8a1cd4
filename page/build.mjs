// Bundles the page into ../piccolo/apps/report/page; with --check, fails if what is there differs from the sources.
import { build } from "esbuild";
import { readFileSync, writeFileSync } from "node:fs";
import { fileURLToPath } from "node:url";

const out = new URL("../piccolo/apps/report/page/", import.meta.url);

const made = await build({
  absWorkingDir: fileURLToPath(new URL(".", import.meta.url)),
  entryPoints: { app: "src/main.ts", style: "src/style.css" },
  bundle: true,
  minify: true,
  format: "iife",
  target: ["chrome100", "firefox100", "safari15.4"],
  charset: "ascii",
  legalComments: "none",
  banner: { js: "/* PICCOLO report page, GPL-3.0-or-later */" },
  outdir: "out",
  write: false,
});
const files = {
  "app.js": made.outputFiles.find((file) => file.path.endsWith("app.js")).text,
  "app.css": made.outputFiles.find((file) => file.path.endsWith("style.css")).text,
  "index.html": readFileSync(new URL("src/index.html", import.meta.url), "utf8"),
};

let differs = false;
for (const [name, text] of Object.entries(files)) {
  const path = new URL(name, out);
  if (process.argv.includes("--check")) {
    if (readFileSync(path, "utf8") !== text) {
      console.error(`${fileURLToPath(path)}: differs from its sources; npm run build`);
      differs = true;
    }
  } else {
    writeFileSync(path, text);
    console.log(`${name} ${Buffer.byteLength(text)} bytes`);
  }
}
process.exitCode = differs ? 1 : 0;
