import { t } from "../i18n/i18n";

export function SensorsView(): preact.JSX.Element {
  return (
    <>
      <h2>{t("view.sensors")}</h2>
      <p class="muted">{t("view.coming", { command: "./fognav area list" })}</p>
    </>
  );
}
