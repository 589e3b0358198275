import { t } from "../i18n/i18n";

export function TimelineView(): preact.JSX.Element {
  return (
    <>
      <h2>{t("view.timeline")}</h2>
      <p class="muted">{t("view.coming", { command: "./fognav area history" })}</p>
    </>
  );
}
