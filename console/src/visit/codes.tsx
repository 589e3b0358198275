// A code for each public place, to be printed: the address of its visits, with a guest's token that is printed with it.
import { encode } from "uqr";
import { useEffect, useState } from "preact/hooks";
import { Problem, request } from "../api/client";
import type { PublicPlace, Session } from "../api/types";
import { t } from "../i18n/i18n";
import { visitHash } from "../router";
import { sentence } from "../stop";
import "./visit.css";

const LOOPBACK = /^(localhost|127\.|\[::1\])/;

interface Props {
  /** Whether who looks at it has codes of their own, as admins do. */
  readonly own: boolean;
}

export function CodesPage({ own }: Props): preact.JSX.Element {
  const [places, setPlaces] = useState<readonly PublicPlace[] | null>(null);
  const [token, setToken] = useState("");
  const [checked, setChecked] = useState("");
  const [problem, setProblem] = useState("");
  const failed = (error: unknown): void => setProblem(sentence(error));
  useEffect(() => void request<PublicPlace[]>("GET", "visits/places").then(({ value }) => setPlaces(value), failed), []);

  useEffect(() => {
    if (own) void request<{ readonly token: string }>("POST", "session/code").then(({ value }) => setChecked(value.token), failed);
  }, [own]);

  // What hangs on a wall is everybody's: no other token than a guest's may get there.
  const check = async (event: Event): Promise<void> => {
    event.preventDefault();
    setChecked("");
    setProblem("");
    try {
      const { value } = await request<Session>("GET", "session", { headers: { Authorization: `Bearer ${token.trim()}` } });
      if (value.role === "guest") setChecked(token.trim());
      else setProblem(t("codes.notGuest", { role: t(`role.${value.role}`) }));
    } catch (error) {
      if (error instanceof Problem && error.status === 401) setProblem(t("login.wrong"));
      else failed(error);
    }
  };

  return (
    <main class="codes">
      <h1>{t("codes.title")}</h1>
      <p>{t("codes.how")}</p>
      {LOOPBACK.test(location.hostname) && <p class="problem">{t("codes.loopback", { host: location.hostname })}</p>}
      {places?.length === 0 && <p class="problem">{t("codes.none")}</p>}
      {own && <p class="muted">{t("codes.own")}</p>}
      <details open={!own}>
      <summary>{t("codes.other")}</summary>
      <form onSubmit={(event) => void check(event)}>
        <label for="guest-token">{t("codes.token")}</label>
        <input
          id="guest-token" type="password" autocomplete="off" required spellcheck={false} aria-describedby="guest-how guest-wrong"
          value={token} onInput={(event) => setToken(event.currentTarget.value)}
        />
        <p id="guest-how" class="muted">{t("codes.tokenHow")}</p>
        <button class={own ? "" : "primary"}>{t("codes.make")}</button>
      </form>
      </details>
      <p id="guest-wrong" class="problem" role="alert">{problem}</p>
      {checked !== "" && <button class="primary" onClick={() => print()}>{t("codes.print")}</button>}
      <a href="#/map">{t("codes.back")}</a>
      {checked !== "" && (
        <ul>
          {places?.map(({ id, label }) => (
            <li key={id}>
              <h2><bdi>{label || id}</bdi></h2>
              <Code text={`${location.origin}${location.pathname}${visitHash(id, checked)}`} name={t("codes.alt", { place: label || id })} />
              <p>{t("codes.scan")}</p>
            </li>
          ))}
        </ul>
      )}
    </main>
  );
}

function Code({ text, name }: { readonly text: string; readonly name: string }): preact.JSX.Element {
  const { data, size } = encode(text, { ecc: "M", border: 4 });
  const path = data.flatMap((row, y) => row.map((black, x) => (black ? `M${x} ${y}h1v1h-1z` : ""))).join("");
  return <svg viewBox={`0 0 ${size} ${size}`} role="img" aria-label={name} shape-rendering="crispEdges"><path d={path} /></svg>;
}
