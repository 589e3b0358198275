// The login: a token becomes a session, which the browser keeps as a cookie that no script can read.
import { useState } from "preact/hooks";
import { Problem, request } from "./api/client";
import type { Session } from "./api/types";
import { t } from "./i18n/i18n";
import { sentence } from "./stop";

export async function logIn(token: string): Promise<Session> {
  await request("POST", "session", { body: { token } });
  return currentSession();
}

export async function currentSession(): Promise<Session> {
  return (await request<Session>("GET", "session")).value;
}

/** End the session; throws a `Problem` if it goes on. One that has ended already is no problem. */
export async function logOut(): Promise<void> {
  try {
    await request("DELETE", "session");
  } catch (error) {
    if (!(error instanceof Problem && error.status === 401)) throw error;
  }
}

interface Props {
  /** Why the user is here again; empty at the first time. */
  readonly notice: string;
  readonly onSession: (session: Session) => void;
}

export function Login({ notice, onSession }: Props): preact.JSX.Element {
  const [token, setToken] = useState("");
  const [wrong, setWrong] = useState(notice);
  const [waiting, setWaiting] = useState(false);

  const submit = async (event: Event): Promise<void> => {
    event.preventDefault();
    setWaiting(true);
    try {
      onSession(await logIn(token.trim()));
    } catch (error) {
      setWrong(error instanceof Problem && error.status === 401 ? t("login.wrong") : sentence(error));
      setWaiting(false);
    }
  };

  return (
    <main class="login" id="content" tabIndex={-1}>
      <form class="card" onSubmit={(event) => void submit(event)}>
        <h1>{t("app.name")}</h1>
        <label for="token">{t("login.token")}</label>
        <input
          id="token" type="password" autocomplete="current-password" required spellcheck={false}
          aria-describedby="token-help token-wrong" aria-invalid={wrong !== ""} value={token}
          onInput={(event) => setToken(event.currentTarget.value)}
        />
        <p id="token-help" class="muted">{t("login.help")}</p>
        <p id="token-wrong" class="problem" role="alert">{wrong}</p>
        <button class="primary" disabled={waiting}>{t("login.submit")}</button>
      </form>
    </main>
  );
}
