// The console's start: takes a one-time login out of the address, then shows the login or the console.
import "leaflet/dist/leaflet.css";
import "./style.css";
import { render } from "preact";
import { useEffect, useState } from "preact/hooks";
import { Problem } from "./api/client";
import type { Session } from "./api/types";
import { ConsoleApp } from "./app";
import { startLanguage, t } from "./i18n/i18n";
import { currentSession, logIn, logOut, Login } from "./login";
import { takeLogin } from "./router";
import { rememberedRobots, StopBar } from "./stop";
import { startTheme } from "./theme";

/** Begin with a one-time login, else with the session that the browser has; null: nobody is logged in. */
async function begin(token: string | null): Promise<Session | null> {
  try {
    return token === null ? await currentSession() : await logIn(token);
  } catch (error) {
    // A one-time login that was used before: the browser may still have its session.
    if (token !== null && error instanceof Problem && error.status === 401) return begin(null);
    return null;
  }
}

function Root({ token }: { readonly token: string | null }): preact.JSX.Element | null {
  const [session, setSession] = useState<Session | null | undefined>(undefined);
  const [notice, setNotice] = useState("");
  const [said, setSaid] = useState("");
  useEffect(() => void begin(token).then(setSession), [token]);
  if (session === undefined) return null;
  const leave = (why: string): void => {
    setNotice(why);
    setSession(null);
  };
  if (session !== null) {
    return (
      <ConsoleApp
        session={session}
        onExpired={() => leave(t("login.expired"))}
        onLogOut={() => void logOut().then(() => leave(""), () => leave(""))}
      />
    );
  }
  const robots = rememberedRobots();
  return (
    <div class="shell">
      <Login notice={notice} onSession={setSession} />
      <p class="said" role="status">{said}</p>
      {robots.length > 0 && <StopBar robot={robots.length === 1 ? robots[0] ?? null : null} robots={robots} say={setSaid} />}
    </div>
  );
}

startLanguage();
startTheme();
const root = document.getElementById("app");
if (root) render(<Root token={takeLogin()} />, root);
