import { useLive } from "../context";
import { t } from "../i18n/i18n";

export function ZonesView(): preact.JSX.Element {
  const live = useLive(["zone"]);
  return (
    <>
      <h2>{t("view.zones")}</h2>
      <p class="muted">{t("view.coming", { command: "./fognav zone add --help" })}</p>
      <ul class="rows">{[...live.of.zone.keys()].map((id) => <li key={id} class="row"><bdi>{id}</bdi></li>)}</ul>
    </>
  );
}
